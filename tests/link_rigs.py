"""Rigs for the `Link` specification: one class per transport. A new transport joins by adding a class to `RIGS`.

A rig opens links to robot "r1", puts raw bytes as a stranger could, and lets time pass.
"""

import json
import socket
import time
from collections.abc import Callable

import pytest
import zenoh
from websockets.sync.client import ClientConnection, connect

from sightline.protocol.errors import LinkError
from sightline.protocol.transports.link import Link
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.protocol.transports.zenoh_session import open_session


def free_endpoint() -> str:
    """An endpoint on loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def until(condition: Callable[[], object], seconds: float = 5.0) -> bool:
    """Wait in real time for `condition`; False if it did not come true in `seconds`."""
    deadline_s = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.002)
    return True


class MemoryRig:
    """Links in one `MemoryNetwork`; time passes in steps of a millisecond."""

    restart_s = 0.0
    """How long an end that restarts must at least be away."""

    def __init__(self) -> None:
        self.network = MemoryNetwork(seed=1, delay_us=4_000)

    def robot(self, robot: str = "r1") -> Link:
        return self.network.link(robot)

    def peer(self, role: str = "vision", robot: str = "r1") -> Link:
        return self.network.link(robot, role)

    def stranger_puts(self, key: str, header: bytes, payload: bytes) -> None:
        self.network.put(key, header, payload)

    def wait(self, seconds: float) -> None:
        self.network.advance(self.network.now_us + round(seconds * 1e6))

    def until(self, condition: Callable[[], object], seconds: float = 5.0) -> bool:
        for _ in range(round(seconds * 1000)):
            if condition():
                return True
            self.wait(0.001)
        return False

    def close(self) -> None:
        pass


class ZenohRig:
    """Real sessions over loopback: the robot listens, all others connect to it."""

    restart_s = 0.0

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self._links: list[Link] = []
        self._stranger: zenoh.Session | None = None

    def _opened(self, link: Link) -> Link:
        self._links.append(link)
        return link

    def robot(self, robot: str = "r1") -> Link:
        return self._opened(open_zenoh(robot, listen=[self.endpoint]))

    def peer(self, role: str = "vision", robot: str = "r1") -> Link:
        return self._opened(open_zenoh(robot, connect=[self.endpoint], role=role))

    def stranger_puts(self, key: str, header: bytes, payload: bytes) -> None:
        if self._stranger is None:
            self._stranger = open_session((), [self.endpoint], 5.0)
        self._stranger.put(key, payload, attachment=header)

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)

    def until(self, condition: Callable[[], object], seconds: float = 5.0) -> bool:
        return until(condition, seconds)

    def close(self) -> None:
        for link in self._links:
            link.close()
        if self._stranger is not None:
            self._stranger.close()


class RelayedZenohRig(ZenohRig):
    """Robot and peers are clients of a router in between, as with vision's box or `sightline router`."""

    def __init__(self) -> None:
        super().__init__()
        self._router = open_session([self.endpoint], (), 5.0)

    def robot(self, robot: str = "r1") -> Link:
        return self._opened(open_zenoh(robot, connect=[self.endpoint]))

    def close(self) -> None:
        super().close()
        self._router.close()


class ChainedZenohRig(RelayedZenohRig):
    """The robot listens and also connects to the router; peers know only the router."""

    # Between routers Zenoh 1.10 computes its trees 100 ms late; one that is replaced by another within that time is
    # taken for the same and told of no subscription (eclipse-zenoh/zenoh issue 1886). No process starts that fast.
    restart_s = 0.2

    def robot(self, robot: str = "r1") -> Link:
        link = self._opened(open_zenoh(robot, listen=[free_endpoint()], connect=[self.endpoint]))
        assert self.until(lambda: link.connected)  # type: ignore[attr-defined]
        return link


class WebSocketRig(ZenohRig):
    """Real connections over loopback: the robot listens, all others connect to it."""

    def __init__(self) -> None:
        super().__init__()
        self.endpoint = self.endpoint.replace("tcp/", "ws://")
        self._claimant: ClientConnection | None = None

    def robot(self, robot: str = "r1") -> Link:
        return self._opened(open_websocket(robot, listen=self.endpoint))

    def peer(self, role: str = "vision", robot: str = "r1") -> Link:
        if robot == "r1":
            return self._opened(open_websocket(robot, connect=self.endpoint, role=role))
        with pytest.raises(LinkError, match=f"this is robot r1, not {robot}"):  # one endpoint serves one robot
            open_websocket(robot, connect=self.endpoint, role=role)
        return self._opened(open_websocket(robot, listen=free_endpoint().replace("tcp/", "ws://"), role=role))

    def stranger_puts(self, key: str, header: bytes, payload: bytes) -> None:
        if self._claimant is None:
            self._claimant = hail(self.endpoint, role="vision")
        self._claimant.send(claim(key, header, payload))

    def close(self) -> None:
        super().close()
        if self._claimant is not None:
            self._claimant.close()


def hail(endpoint: str, **hello: object) -> ClientConnection:
    """A bare client of `sightline.v1` that has said hello and been answered."""
    connection = connect(endpoint, subprotocols=["sightline.v1"], compression=None, legacy=True)
    connection.send(json.dumps({"robot": "r1", "session": "0000beef"} | hello))
    connection.recv(5)
    return connection


def claim(key: str, header: bytes, payload: bytes) -> bytes:
    """A binary message that claims to be of `key`, as far as the framing has words for it."""
    channel, _, source = key.removeprefix("sightline/r1/").partition("/")
    if not key.startswith("sightline/r1/"):
        channel, source = key, ""
    block = json.dumps({"channel": channel, "source": source}, separators=(",", ":")).encode() + header
    return len(block).to_bytes(2) + block + payload


RIGS = {
    "memory": MemoryRig,
    "websocket": WebSocketRig,
    "zenoh": ZenohRig,
    "zenoh-relayed": RelayedZenohRig,
    "zenoh-chained": ChainedZenohRig,
}
