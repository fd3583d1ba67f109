"""The simulation's side of the bus: who is connected, and what they say. Shell (sockets, one thread).

The thread accepts and receives; the physics loop only sends, and never waits: what a client does not take is dropped.
"""

import errno
import fcntl
import os
import selectors
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.sim.bus import CAMERA, MOTION, PICTURE_REQUEST, RANGE, TRUTH

SEND_BYTES = {MOTION: 4096, RANGE: 16_384, CAMERA: 1 << 20, TRUTH: 1 << 17}
"""How much may wait for a client that does not read; little where only the newest is worth anything."""
STOP_POLL_S = 0.2


class SocketFolder:
    """The folder of sockets, held by one simulation at a time through a lock that dies with its process."""

    def __init__(self, path: str) -> None:
        self.path = Path(path)
        try:
            self.path.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = os.open(self.path / "sim.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise ConfigError(f"socket_dir {path}: {error.strerror}; choose another with --set socket_dir=") from None
        self._hold()

    def _hold(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(self._lock, 32).decode("ascii", "replace").strip() or "?"
            os.close(self._lock)
            raise ConfigError(
                f"socket_dir {self.path} is held by another simulation, process {holder}; "
                "end it or choose another with --set socket_dir="
            ) from None
        os.ftruncate(self._lock, 0)
        os.write(self._lock, f"{os.getpid()}\n".encode())

    def listen(self, name: str) -> socket.socket:
        """A listening socket in place of whatever a dead simulation left."""
        place = self.path / name
        place.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        listener.setblocking(False)
        listener.bind(str(place))
        listener.listen(8)
        return listener

    def close(self) -> None:
        """Remove the sockets, then let go; idempotent."""
        if self._lock >= 0:
            for name in SEND_BYTES:
                (self.path / name).unlink(missing_ok=True)
            os.close(self._lock)
            self._lock = -1


class BusClients:
    """Everybody connected to the four sockets of a folder."""

    def __init__(self, folder: SocketFolder, hellos: dict[str, bytes], on_motion: Callable[[bytes], None]) -> None:
        self._hellos, self._on_motion = hellos, on_motion
        self._lock = threading.Lock()
        self._clients: dict[str, set[socket.socket]] = {name: set() for name in SEND_BYTES}
        self._wanting: dict[socket.socket, tuple[int, int]] = {}
        self._selector = selectors.DefaultSelector()
        self._listeners = {name: folder.listen(name) for name in SEND_BYTES}
        for name, listener in self._listeners.items():
            self._selector.register(listener, selectors.EVENT_READ, name)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="sim-sockets", daemon=True)
        self._thread.start()

    def has(self, name: str) -> bool:
        """Whether anybody is connected there."""
        return bool(self._clients[name])

    def send(self, name: str, data: bytes) -> None:
        """Send to everybody there who has room."""
        with self._lock:
            for client in self._clients[name]:
                _send(client, data)

    def wanted_pictures(self) -> set[tuple[int, int]]:
        """The (quality_percent, scale_percent) that cameras asked the next capture in."""
        with self._lock:
            return set(self._wanting.values())

    def send_picture(self, wanted: tuple[int, int], data: bytes) -> None:
        """Send to the cameras that asked for it so, which settles their requests."""
        with self._lock:
            for client in [one for one, asked in self._wanting.items() if asked == wanted]:
                _send(client, data)
                del self._wanting[client]

    def _serve(self) -> None:
        while not self._stopping.is_set():
            for key, _ in self._selector.select(STOP_POLL_S):
                connection, name = key.fileobj, key.data
                assert isinstance(connection, socket.socket)
                if connection is self._listeners[name]:
                    self._accept(connection, name)
                else:
                    self._receive(connection, name)

    def _accept(self, listener: socket.socket, name: str) -> None:
        try:
            client, _ = listener.accept()
        except OSError:
            return  # it went away again
        client.setblocking(False)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES[name])
        if name in self._hellos:
            _send(client, self._hellos[name])
        self._selector.register(client, selectors.EVENT_READ, name)
        with self._lock:
            self._clients[name].add(client)

    def _receive(self, client: socket.socket, name: str) -> None:
        try:
            data = client.recv(64)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client, name)
        elif name == MOTION:
            self._on_motion(data)
        elif name == CAMERA:
            with self._lock:
                self._wanting[client] = _wanted(data)

    def _drop(self, client: socket.socket, name: str) -> None:
        self._selector.unregister(client)
        with self._lock:
            self._clients[name].discard(client)
            self._wanting.pop(client, None)
            client.close()

    def close(self) -> None:
        """End the thread and every connection."""
        self._stopping.set()
        self._thread.join(timeout=5 * STOP_POLL_S)
        with self._lock:
            for connection in (*self._listeners.values(), *(c for held in self._clients.values() for c in held)):
                connection.close()
        self._selector.close()


def _send(client: socket.socket, data: bytes) -> None:
    """Send or drop: a full buffer and a client that just left are no concern of the physics."""
    try:
        client.send(data)
    except OSError as error:
        if error.errno == errno.EMSGSIZE:
            raise HardwareError(
                f"a picture of {len(data)} bytes does not fit a local socket; lower jpeg_quality or the camera's size"
            ) from None


def _wanted(data: bytes) -> tuple[int, int]:
    """How a picture was asked for; what is no such request asks for it as it is."""
    if len(data) != PICTURE_REQUEST.size:
        return 100, 100
    quality_percent, scale_percent = PICTURE_REQUEST.unpack(data)
    return max(1, min(100, quality_percent)), max(1, min(100, scale_percent))
