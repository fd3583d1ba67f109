"""A relay between the vision service and the robot, in place of the radio. Shell (a process, sockets).

    python -m sightline.evaluation.demo.relay LISTEN_PORT ROBOT_PORT

All bytes between them pass this process. SIGSTOP stops the bytes without closing a connection, as a radio does
out of range. SIGCONT lets them pass again, the old ones first.
"""

import contextlib
import socket
import sys
import threading
from typing import Final

READY: Final = "relay is on"
LOOPBACK: Final = "127.0.0.1"
_CHUNK_BYTES: Final = 65_536
# Small, because data that wait here during an outage are old when the link returns.
_BUFFER_BYTES: Final = 16_384


def pump(source: socket.socket, sink: socket.socket) -> None:
    """Pass bytes from `source` to `sink` until one of them ends; then end both."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK_BYTES):
            sink.sendall(data)
    for end in (source, sink):
        with contextlib.suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


def relay(client: socket.socket, robot_port: int) -> None:
    """Connect `client` to the robot, or close it if the robot does not listen."""
    try:
        robot = socket.create_connection((LOOPBACK, robot_port), timeout=5.0)
    except OSError:
        client.close()
        return
    robot.settimeout(None)
    for end in (client, robot):
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
    for name, source, sink in (("to robot", client, robot), ("from robot", robot, client)):
        threading.Thread(target=pump, args=(source, sink), name=f"relay {name}", daemon=True).start()


def main() -> int:
    """Accept clients until a signal ends the process."""
    listen_port, robot_port = (int(text) for text in sys.argv[1:3])
    with socket.create_server((LOOPBACK, listen_port)) as server:
        print(READY, flush=True)
        while True:
            client, _ = server.accept()
            relay(client, robot_port)


if __name__ == "__main__":
    sys.exit(main())
