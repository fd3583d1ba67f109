"""The legacy article's robot server, in our words, with its library SimpleWebSocketServer and a folder as its camera.

    python old_robot.py PORT PICTURES EVENTS.csv [dashed]

Its library sends only when its loop comes round, every 0.1 s or when something comes in: in bursts. No pings, no close
frame, text only. It writes `t_us,sent,` when a picture has left for the socket, `t_us,said,TEXT` for what comes in.
"""

import base64
import itertools
import sys
import threading
import time
from pathlib import Path

from SimpleWebSocketServer import SimpleWebSocketServer, WebSocket

FPS = 30
clients = []


def main(port, pictures, path):
    log = open(path, "a", buffering=1)  # noqa: PTH123, SIM115

    def note(what, text=""):
        log.write(f"{time.monotonic_ns() // 1000},{what},{text}\n")

    class Hub(WebSocket):
        def handleMessage(self):  # noqa: N802
            note("said", self.data)

        def handleConnected(self):  # noqa: N802
            clients.append(self)
            note("connected")

        def handleClose(self):  # noqa: N802
            clients.remove(self)
            note("closed")

        def _sendBuffer(self, buff, send_all=False):  # noqa: N802
            left = super()._sendBuffer(buff, send_all)
            if left is None and len(buff) > 1000:
                note("sent")
            return left

    threading.Thread(target=film, args=(pictures,), daemon=True).start()
    server = SimpleWebSocketServer("127.0.0.1", int(port), Hub)
    note("up")
    server.serveforever()


def film(pictures):
    """The camera's thread gives each picture to every client."""
    texts = [base64.encodebytes(path.read_bytes()).decode() for path in sorted(Path(pictures).glob("*.jpg"))]
    due_s = time.monotonic()
    for text in itertools.cycle(texts):
        for client in list(clients):
            client.sendMessage(text)
        due_s += 1 / FPS
        time.sleep(max(0.0, due_s - time.monotonic()))


if __name__ == "__main__":
    main(*sys.argv[1:4])
