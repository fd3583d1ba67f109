"""STOP of one robot by datagrams, and also by its link if they are not answered soon, until one proves the stop.
Shell (threads).

The datagrams are sent first. Opening a link can take seconds, or fail, while a flood occupies its ports. The libraries
of a link also take longer to import than the modules of a datagram.
"""

import os
import select
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, Final

from sightline.protocol.errors import ConfigError, LinkError, SightlineError
from sightline.protocol.transports.endpoints import stop_addresses
from sightline.protocol.transports.stop_datagram import DATAGRAM_BYTES, STOP_SLOW_S, StopRequests
from sightline.protocol.transports.stop_port import read_secret

if TYPE_CHECKING:
    from sightline.operator_side.client.requests import Operator
    from sightline.protocol.messages import Status

Place = tuple[Any, ...]
"""Address of a socket: host and port, for IPv6 also flow and scope."""
DATAGRAM_PERIOD_S: Final = 0.02
_STORED_S: Final = 1.0
"""Longest wait for the disk of a stopped robot with its wheels at zero."""
_ANSWERED_S: Final = 1.0
"""Wait for an answer to a datagram if the link cannot be opened; also the wait for the wheels before it is opened."""
_LINK_CLOSES_S: Final = 0.3
_RESOLVED_S: Final = 0.5
"""Longest wait for the addresses of a robot's name."""
_RESOLVE_AGAIN_S: Final = 1.0
_FIRST_S: Final = 0.05
"""Wait for the answer that the robot has applied a datagram, before the link is opened."""


class StopSender:
    """Sends STOP datagrams to the STOP ports of `endpoints` until `close`. Use it in a `with`."""

    def __init__(self, robot: str, endpoints: Sequence[str], secret_file: str = "") -> None:
        """Start the sending threads.

        Args:
            robot: robot id.
            endpoints: endpoints of the robot or of its router, as for a link.
            secret_file: file of the STOP secret, or "" without keys.
        """
        self._robot, self._secret = robot, read_secret(secret_file)
        self._requests: list[StopRequests] = []
        """One for each address, because two hosts with one name have different challenges."""
        self._answered_s = 0.0
        self._ending = threading.Event()
        self._sent, self._latched = threading.Event(), threading.Event()
        # One for each name, because a name server may take seconds.
        self._threads = [threading.Thread(target=self._run, args=(address,), name="stop datagrams", daemon=True)
                         for address in stop_addresses(endpoints)]
        for thread in self._threads:
            thread.start()

    def __enter__(self) -> "StopSender":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop sending."""
        self._ending.set()

    @property
    def is_answered(self) -> bool:
        """Return True if a robot has answered."""
        return any(one.answer is not None for one in self._requests)

    @property
    def is_latched(self) -> bool:
        """Return True once the robot has applied this STOP. Its wheels may still turn."""
        return any(one.is_latched for one in self._requests)

    def wait(self, seconds: float) -> bool:
        """Wait until the robot has applied this STOP. Returns False `seconds` after the first datagrams."""
        self._sent.wait(_RESOLVED_S)
        return self._latched.wait(seconds)

    @property
    def is_stopped(self) -> bool:
        """Return True once the robot has applied this STOP and its wheels are at zero."""
        return any(one.is_stopped for one in self._requests)

    @property
    def denies_zero(self) -> bool:
        """Return True if the robot answers that its wheels are not at zero. This overrides the status on its link."""
        return self.is_latched and not self.is_stopped and time.monotonic() - self._answered_s < _ANSWERED_S

    @property
    def is_stored(self) -> bool:
        """Return True once the STOP is on the disk of the robot, too."""
        return any(one.is_stored for one in self._requests)

    @property
    def lacks_secret(self) -> bool:
        """Return True if the robot accepts only datagrams with the HMAC of its STOP secret."""
        return any(one.lacks_secret for one in self._requests)

    @property
    def has_other_secret(self) -> bool:
        """Return True if a robot answered with the HMAC of another STOP secret."""
        return any(one.has_other_secret for one in self._requests)

    def _run(self, address: tuple[str, int]) -> None:
        while not (places := _resolve(address)):
            self._sent.set()  # no address, so nothing to wait for
            if self._ending.wait(_RESOLVE_AGAIN_S):
                return
        with ExitStack() as ending:
            senders: dict[socket.socket, tuple[Place, StopRequests]] = {}
            for family, place in places:
                with suppress(OSError):  # the system has no IPv6
                    one = ending.enter_context(socket.socket(family, socket.SOCK_DGRAM))
                    senders[one] = place, StopRequests(self._robot, self._secret, int.from_bytes(os.urandom(8)) >> 2)
            self._requests += [requests for _, requests in senders.values()]
            while not self._ending.is_set():
                for one, (place, requests) in senders.items():
                    self._send(one, place, requests)
                self._sent.set()
                self._receive(senders, time.monotonic() + DATAGRAM_PERIOD_S)

    @staticmethod
    def _send(one: socket.socket, place: Place, requests: StopRequests) -> None:
        for data in requests.datagrams():
            with suppress(OSError):  # e.g. no route now
                one.sendto(data, place)

    def _receive(self, senders: Mapping[socket.socket, tuple[Place, StopRequests]], until_s: float) -> None:
        while (left_s := until_s - time.monotonic()) > 0:
            for one in select.select(senders, [], [], left_s)[0]:
                with suppress(OSError):
                    data, place = one.recvfrom(DATAGRAM_BYTES + 1)
                    requests = senders[one][1]
                    before = requests.answer
                    if requests.on_datagram(data):
                        self._send(one, place, requests)
                    if requests.answer is not before:
                        self._answered_s = time.monotonic()
                    if requests.is_latched:
                        self._latched.set()


def _resolve(address: tuple[str, int]) -> list[tuple[socket.AddressFamily, Place]]:
    """Return the first address of each family, because a name may have both while its host listens on one."""
    try:
        found = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError):
        return []
    return list({family: place for family, _, _, _, place in reversed(found)}.items())


class _LinkStop(threading.Thread):
    """Opens the link and sends STOP on it."""

    def __init__(self, name: str, robot: str, connect: Sequence[str], secure: str, timeout_s: float) -> None:
        super().__init__(name=name, daemon=True)
        self._robot, self._connect, self._secure, self._timeout_s = robot, connect, secure, timeout_s
        self._operator: Operator | None = None
        self.ended = threading.Event()
        """Set by the caller to end the sending of STOP."""
        self.status: Status | None = None
        self.error: SightlineError | None = None

    def run(self) -> None:
        """Set `status` or `error`."""
        from sightline.operator_side.client.requests import SOURCE, Operator
        from sightline.protocol.transports.open import open_link

        try:
            with open_link(self._robot, connect=self._connect, role=SOURCE, secure=self._secure) as link:
                self._operator = Operator(link)
                self.status = self._operator.stop(lambda: None, self._timeout_s, self.ended.is_set)
        except SightlineError as error:
            self.error = error

    @property
    def has_report(self) -> bool:
        """Return True if a status came."""
        return self._operator is not None and self._operator.report is not None

    @property
    def is_latched(self) -> bool:
        """Return True if the newest status shows STOPPED."""
        report = self._operator.report if self._operator else None
        return report is not None and report.status.state == "STOPPED"


def stop_robot(
    robot: str, connect: Sequence[str], secure: str, secret_file: str, on_slow: Callable[[], None], *,
    on_other_secret: Callable[[], None] = lambda: None, timeout_s: float = 10.0, thread_name: str = "stop link",
) -> bool:
    """Stop a robot by datagrams, and without an answer by its link. Returns when it is STOPPED with wheels at zero.

    Args:
        robot: robot id.
        connect: endpoints of the robot or of its router.
        secure: folder of keys, or "".
        secret_file: file of the STOP secret, or "".
        on_slow: called once if the robot has not shown STOPPED after 300 ms.
        on_other_secret: called at the end if the STOP secret of the robot is another one.
        timeout_s: longest wait, s.
        thread_name: of the thread that opens the link. It may still run when this function returns.

    Returns:
        False if the robot answers that the STOP is not on its disk.

    Raises:
        SightlineError: that of the link, if no datagram is answered; or at `timeout_s`. The robot may still move.
    """
    with StopSender(robot, connect, secret_file) as sender:
        link = _LinkStop(thread_name, robot, connect, secure, timeout_s)
        if not sender.wait(_FIRST_S):
            link.start()
        try:
            return _wait(robot, sender, link, on_slow, timeout_s)
        finally:
            if sender.has_other_secret:
                on_other_secret()
            link.ended.set()
            if link.is_alive():
                link.join(_LINK_CLOSES_S)


def _can_stop(sender: StopSender, error: SightlineError) -> bool:
    """Return True if the datagrams may still stop the robot, although the link has failed.

    Without its secret they cannot. Usually `error` is then the cause of both, e.g. keys that are not in the options.
    """
    return sender.is_answered and not (sender.lacks_secret and isinstance(error, ConfigError))


def _wait(robot: str, sender: StopSender, link: _LinkStop, on_slow: Callable[[], None], timeout_s: float) -> bool:
    began_s = time.monotonic()
    stopped_s: float | None = None
    warned = False
    while (now_s := time.monotonic()) - began_s < timeout_s:
        if sender.is_stored:
            return True
        if sender.is_stopped or (link.status is not None and not sender.denies_zero):
            stopped_s = stopped_s or now_s
            has_report = sender.is_answered and not sender.lacks_secret
            if not has_report or now_s - stopped_s > _STORED_S:
                return not sender.is_stopped
        elif link.error is not None and now_s - began_s > _ANSWERED_S and not _can_stop(sender, link.error):
            raise link.error
        elif link.ident is None and now_s - began_s > _ANSWERED_S:  # it is applied, but the wheels are not at zero
            link.start()
        if not warned and now_s - began_s > STOP_SLOW_S and not (sender.is_latched or link.is_latched):
            warned = True
            on_slow()
        time.sleep(DATAGRAM_PERIOD_S / 4)
    hint = "; copy stop.secret of the robot's keys to this machine" if sender.lacks_secret else ""
    if not sender.is_answered and not link.has_report:
        hint += f"; if '{robot}' is not its id, `sightline robots` lists the ids"
    raise LinkError(f"robot '{robot}' did not confirm STOP within {timeout_s:g} s; cut its power by hand{hint}")
