"""Vision services over the library `websockets`: a good service, and a broken service per defect. Shell.

They look at nothing: every frame is answered by a twist of zeros. `SOCKETS` maps a case's id to what is wrong.
"""

import contextlib
import json
import threading
import time
from collections import deque

from websockets.exceptions import ConnectionClosedError, WebSocketException
from websockets.frames import Opcode
from websockets.sync.client import connect

from sightline.conformance.vision.images import picture
from sightline.conformance.vision.websocket import SESSION_BEGINS

SOCKETS = {
    "V-SOCK-01": "offers a sub-protocol of its own",
    "V-SOCK-02": "means every robot",
    "V-SOCK-03": "wants the camera only",
    "V-SOCK-04": "has no role",
    "V-SOCK-05": "follows each sender of a hello",
    "V-SOCK-06": "answers in a text",
    "V-SOCK-07": "takes the first fragment for all",
    "V-SOCK-08": "is deaf to pings",
    "V-SOCK-09": "never pings",
    "V-SOCK-10": "reads on after a broken block",
    "V-SOCK-11": "takes any size",
    "V-SOCK-12": "needs no hello",
    "V-SOCK-13": "gives up after a reset",
    "V-SOCK-14": "shows its token twice",
    "V-SOCK-15": "shows its token in the URL too",
    "V-SOCK-16": "comes from another site",
    "V-SOCK-17": "waits for the silent",
    "V-SOCK-18": "leaves a robot whose pong is late",
    "V-SOCK-19": "greets a robot of any version",
    "V-SOCK-20": "takes any session",
    "V-SOCK-21": "reads one hello only",
    "V-SOCK-22": "draws unasked",
    "V-SOCK-23": "tries again at once",
    "V-SOCK-24": "reads headers of any size",
}

SILENCE_S = 3.0
"""As long as pings and their patience take together."""


class SocketVision:
    """Use it in a `with`: it connects to `endpoint` again and again. `broken` is a case's id, or empty."""

    def __init__(self, endpoint, broken="", token=""):
        self.endpoint, self.broken, self.token = endpoint, broken, token
        self.ending = threading.Event()
        self.seq, self.greeted, self.pause_s = 0, False, 0.2
        self.thread = threading.Thread(target=self.run, daemon=True)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *_):
        self.ending.set()
        self.thread.join(5)

    def run(self):
        while not self.ending.is_set():
            try:
                self.connected()
            except ConnectionClosedError as error:
                if self.broken == "V-SOCK-13" and self.greeted and error.rcvd is None and error.sent is None:
                    return
            except (OSError, WebSocketException, EOFError):
                pass
            self.ending.wait(0.05 if self.broken == "V-SOCK-23" else self.pause_s)
            self.pause_s = min(1.0, 1.5 * self.pause_s)

    def connected(self):
        protocols = ["sightline.v9"] if self.broken == "V-SOCK-01" else ["sightline.v1"]
        protocols += [f"sightline.token.{self.token}"] if self.token else []
        twice = {"Authorization": f"Bearer {self.token}"} if self.broken == "V-SOCK-14" else {}
        url = self.endpoint + (f"/?token={self.token}" if self.broken == "V-SOCK-15" else "")
        origin = "http://elsewhere.example" if self.broken == "V-SOCK-16" else None
        pings = None if self.broken == "V-SOCK-09" else 1
        patience = {"V-SOCK-17": None, "V-SOCK-18": 1}.get(self.broken, 2)
        with connect(url, subprotocols=protocols, compression=None, open_timeout=1, close_timeout=0.5,
                     additional_headers=twice, origin=origin, ping_interval=pings, ping_timeout=patience,
                     max_size=None if self.broken == "V-SOCK-11" else 1_100_000) as link:
            self.pause_s = 0.2
            if self.broken == "V-SOCK-08":
                send = link.protocol.send_frame
                link.protocol.send_frame = lambda frame: None if frame.opcode is Opcode.PONG else send(frame)
            self.speak(link)

    def speak(self, link):
        robot = "every" if self.broken == "V-SOCK-02" else "r1"
        hello = {"v": 1, "robot": robot, "role": "vision", "session": "4e5f6071", "wants": ["frame", "camera"]}
        if self.broken == "V-SOCK-03":
            hello["wants"] = ["camera"]
        if self.broken == "V-SOCK-04":
            del hello["role"]
        link.send(json.dumps(hello))
        first = link.recv(timeout=2)
        # By the server of the case, not by the kit's link.
        self.greeted = isinstance(first, str) and json.loads(first)["session"].startswith(SESSION_BEGINS)
        if not isinstance(first, str) and self.broken != "V-SOCK-12":
            link.close(1003, "no hello")
            return
        if isinstance(first, str) and self.rejects(json.loads(first)):
            link.close(1008, "another robot")
            return
        heard = self.listening(link)
        while not self.ending.is_set():
            with contextlib.suppress(TimeoutError):
                self.hear(link, self.received(link))
            if self.broken == "V-SOCK-09" and time.monotonic() - heard[-1] > SILENCE_S:
                return

    def rejects(self, hello, accepts_another="V-SOCK-05"):
        return ((hello["robot"] != "r1" and self.broken != accepts_another)
                or (hello["v"] != 1 and self.broken != "V-SOCK-19")
                or (len(hello["session"]) != 8 and self.broken != "V-SOCK-20"))

    def listening(self, link):
        """Record when bytes arrive, so that a service without pings still detects silence and has only one defect."""
        heard, take = deque([time.monotonic()], maxlen=1), link.protocol.receive_data
        link.protocol.receive_data = lambda data: (heard.append(time.monotonic()), take(data))[1]
        return heard

    def received(self, link):
        if self.broken == "V-SOCK-07":
            fragments = list(link.recv_streaming())
            return fragments[0] if len(fragments) == 1 else ""
        return link.recv(timeout=0.1)

    def hear(self, link, message):
        if isinstance(message, str):
            if message and self.rejects(json.loads(message), "V-SOCK-21"):
                link.close(1008, "another robot")
                raise EOFError
            return
        size = int.from_bytes(message[:2])
        if len(message) < 2 + size:
            if self.broken != "V-SOCK-10":
                link.close(1007, "header block past the end")
                self.ending.wait(0.05)
                raise EOFError
            return
        try:
            header = json.loads(message[2 : 2 + size])
        except ValueError:
            return
        if header.get("channel") == "frame" and (size <= 530 or self.broken == "V-SOCK-24"):
            self.answer(link, header)

    def answer(self, link, frame):
        self.seq += 1
        echo = {"channel": "frame", **{name: frame[name] for name in ("session", "seq", "t_us")}}
        header = {"channel": "twist", "v": 1, "source": "vision", "session": "4e5f6071", "seq": self.seq, "echo": echo}
        block = json.dumps(header).encode()
        if self.broken == "V-SOCK-06":
            del header["channel"]
            block = json.dumps(header).encode()
        link.send(len(block).to_bytes(2) + block + b"0.0000|0.0000")
        if self.broken == "V-SOCK-22":
            block = json.dumps(header | {"channel": "overlay"}).encode()
            link.send(len(block).to_bytes(2) + block + picture("left"))
