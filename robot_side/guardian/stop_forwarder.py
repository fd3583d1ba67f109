"""The STOP forwarder: a process next to a router that forwards STOP datagrams to its robots. Shell.

Behind a router an operator knows only the address of the router. It imports the standard library only.
"""

import os
from collections.abc import Sequence

from sightline.protocol.errors import WireError
from sightline.protocol.transports.stop_datagram import CHALLENGE_BYTES
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
from sightline.robot_side.guardian.stop_core import ForwarderCore, IgnoredDatagrams


def start(addresses: Sequence[Address], secret_file: str) -> StopProcess:
    """Prepare the forwarder of one router. `keep_alive` of the result starts it.

    Args:
        addresses: UDP addresses to listen on.
        secret_file: file of the STOP secret, or "" to let every robot register.
    """
    return StopProcess("robot_side.guardian.stop_forwarder", {"addresses": addresses, "secret_file": secret_file})


class StopForwarder:
    """Connects the sockets to the logic."""

    def __init__(self, port: StopPort, secret: bytes) -> None:
        self._port = port
        self._core = ForwarderCore(secret, os.urandom(CHALLENGE_BYTES))
        self._ignored = IgnoredDatagrams()

    def on_datagram(self, data: bytes, origin: Origin) -> Replies:
        """Forward a datagram, or ignore and count it."""
        try:
            return self._core.on_datagram(data, origin, now_us())
        except WireError as error:
            self._ignored.add(error, origin[1][0])
            return ()

    def on_turn(self) -> None:
        """Report the ignored datagrams once a second."""
        self._ignored.report(self._port.send, now_us())


def main() -> None:
    """Run the forwarder until the router ends."""
    pipe, options = read_arguments()
    port = StopPort(pipe, [(host, number) for host, number in options["addresses"]])
    forwarder = StopForwarder(port, read_secret(options["secret_file"]))
    port.serve(forwarder.on_datagram, lambda _packet: None, forwarder.on_turn)
