"""The network process's hold on its driver: both sockets, and the requests that found no room. Shell."""

import socket
import threading
from contextlib import suppress

from sightline.protocol.channels import REQUEST
from sightline.protocol.transports.link import Message
from sightline.robot_side import pipe as ipc
from sightline.robot_side.held import PendingRequests


class NetworkEnd:
    """The driver as its network process sees it. Only `receive` waits; any thread may call."""

    def __init__(self, waited: socket.socket, aside: socket.socket) -> None:
        self._waited, self._aside = waited, aside
        self._held = PendingRequests()
        self._order = threading.Lock()
        self.dropped_commands = 0

    def receive(self) -> bytes:
        """The next packet, however long it takes; empty when the driver has closed its end."""
        try:
            return self._waited.recv(ipc.MAX_PACKET_BYTES)
        except OSError:
            return b""

    def motion(self, last: ipc.Motion) -> ipc.Motion:
        """The newest that the driver said of the robot; `last` if it said nothing since."""
        with suppress(OSError):
            while packet := self._aside.recv(ipc.MAX_PACKET_BYTES, socket.MSG_DONTWAIT):
                last = ipc.unpack_motion(packet)
        return last

    def tell(self, packet: bytes) -> bool:
        """Hand over a packet that the driver waits for; False if there is no room."""
        return _send_if_room(self._waited, packet)

    def tell_aside(self, packet: bytes) -> bool:
        """Hand over what the driver reads when it needs it; False if there is no room."""
        return _send_if_room(self._aside, packet)

    def forward(self, message: Message) -> None:
        """A command goes on at once, undecoded. Without room a request waits; a twist is dropped and counted."""
        with self._order:
            if self._held.flush(self._pass) and self._pass(message):
                return
            if message.channel is not REQUEST or not self._held.hold(message):
                self.dropped_commands += 1

    def retry(self) -> None:
        """Hand over the requests that wait, as far as there is room now."""
        if len(self._held):
            with self._order:
                self._held.flush(self._pass)

    def _pass(self, message: Message) -> bool:
        return self.tell(ipc.pack_message(ipc.PacketKind.RAW, message))


def _send_if_room(end: socket.socket, packet: bytes) -> bool:
    try:
        end.send(packet, socket.MSG_DONTWAIT)
    except OSError:
        return False
    return True
