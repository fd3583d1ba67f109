"""The STOP receiver: a process that only reads the STOP port of a robot. Shell.

Load on the links cannot delay it. It imports the standard library only. Another process calls `start`.
"""

import os
import time
from collections.abc import Sequence
from typing import Final

from sightline.protocol.errors import WireError
from sightline.protocol.transports.stop_datagram import CHALLENGE_BYTES, unpack_stop
from sightline.protocol.transports.stop_port import (
    Address,
    Origin,
    Replies,
    StopPort,
    StopProcess,
    now_us,
    read_arguments,
    read_secret,
)
from sightline.robot_side.guardian.stop_core import IgnoredDatagrams, ReceiverCore, Registration

_REGISTER_S: Final = 1.0


def start(robot: str, addresses: Sequence[Address], routers: Sequence[Address], secret_file: str) -> StopProcess:
    """Prepare the receiver of one robot. `keep_alive` of the result starts it.

    Args:
        robot: robot id.
        addresses: UDP addresses to listen on.
        routers: UDP addresses of routers, which forward STOPs.
        secret_file: file of the STOP secret, or "" to accept every STOP.
    """
    options = {"robot": robot, "addresses": addresses, "routers": routers, "secret_file": secret_file}
    return StopProcess("robot_side.guardian.stop_receiver", options)


class StopReceiver:
    """Connects the sockets to the logic."""

    def __init__(self, port: StopPort, robot: str, secret: bytes, routers: Sequence[Address]) -> None:
        self._port = port
        self._core = ReceiverCore(robot, secret, os.urandom(CHALLENGE_BYTES), now_us())
        self._routers = [(address, Registration(robot, secret, _random())) for address in routers]
        self._ignored = IgnoredDatagrams()
        self._unreachable: set[Address] = set()
        """Routers to which a datagram could not be sent, as logged."""
        if routers:
            import threading  # only for a robot that connects to a router

            # A separate thread, because a name server may take seconds.
            threading.Thread(target=self._register_all, name="registration", daemon=True).start()

    def _register_all(self) -> None:
        while True:
            self._register()
            time.sleep(_REGISTER_S)

    def _register(self) -> None:
        for address, registration in self._routers:
            problem = self._port.send_out(registration.datagram(), address)
            if problem and address not in self._unreachable:
                self._unreachable.add(address)
                self._port.log(f"STOP port {address[0]}:{address[1]}/udp of the router: {problem}; trying again, until "
                               "then STOP needs the link")

    def on_datagram(self, data: bytes, origin: Origin) -> Replies:
        """Answer a datagram, or ignore and count it."""
        try:
            one = unpack_stop(data)
            if awaiting := [registration for _, registration in self._routers if registration.awaits(one)]:
                answers = (registration.on_answer(data, one) for registration in awaiting)
                return [(answer, origin) for answer in answers if answer is not None]
            return [(self._core.on_stop(data, one, now_us()), origin)]
        except WireError as error:
            self._ignored.add(error, origin[1][0])
            return ()

    def on_report(self, packet: bytes) -> None:
        """Process a report of the driver process."""
        self._core.on_report(packet, now_us())

    def on_turn(self) -> None:
        """Send a new STOP to the driver process."""
        packet = self._core.packet(now_us())
        if packet is not None:
            self._port.send(packet)
        self._ignored.report(self._port.send, now_us())


def _random() -> int:
    return int.from_bytes(os.urandom(7), "big")


def main() -> None:
    """Run the receiver until no process holds the other end of its pipe."""
    pipe, options = read_arguments()
    addresses, routers = ([(host, port) for host, port in options[key]] for key in ("addresses", "routers"))
    port = StopPort(pipe, addresses, outgoing=bool(routers))
    receiver = StopReceiver(port, options["robot"], read_secret(options["secret_file"]), routers)
    port.serve(receiver.on_datagram, receiver.on_report, receiver.on_turn)
