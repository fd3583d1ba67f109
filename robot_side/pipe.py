"""The pipe between driver and network process: packets, pending requests, and both ends. Shell.

    network -> driver   RAW          bytes of a twist or request as received: channel, source, header, payload
                        STREAM       stream counters, JSON
                        REJECTED     rejections of the transport so far: count by reason
                        FAULTS       exceptions since the last such packet: count by part
                        READY        the endpoint is open
                        TOKEN        the token of a driver appeared or ended
              aside     ISSUED       a frame is about to be published: seq, capture time, fingerprint
    driver -> network   COMMAND_ACK  a twist was validated: sender, frame, computing time, lease holder
                        PUBLISH      bytes to publish: channel, header, payload
              aside     MOTION       motion of the robot for the header of the next frame

`aside` is a second socket that no process waits on; a process reads all of it when it needs the data. So a frame that
leaves does not wake the driver while the vision service needs the processor, and a tick does not wake the network
process. The driver reads ISSUED before it validates a RAW. ISSUED is sent before the frame, so before any answer.
"""

import json
import logging
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from sightline.protocol.channels import CHANNELS, REQUEST
from sightline.protocol.codec import request_verb
from sightline.protocol.config import Config
from sightline.protocol.messages import Holder, Planar, Pose, SessionId
from sightline.protocol.transports.link import Message, OutgoingQueue
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver.supervision import EXIT_SIGNALS

_log: Final = logging.getLogger(__name__)

MAX_PACKET_BYTES = 65_536
_ISSUED = struct.Struct("<BQQI")
_MOTION = struct.Struct("<B7dq")
_ACK = struct.Struct("<BQQ16s8s16s8s")
_PARTS = struct.Struct("<B16s16sH")


class PacketKind(IntEnum):
    """First byte of a packet."""

    ISSUED = 1
    RAW = 2
    STREAM = 3
    READY = 4
    MOTION = 5
    COMMAND_ACK = 6
    PUBLISH = 7
    REJECTED = 8
    FAULTS = 9
    TOKEN = 10


@dataclass(frozen=True, slots=True)
class RobotMotion:
    """The current motion of the robot, for frame headers."""

    pose: Pose = (0.0, 0.0, 0.0)
    moving: Planar = (0.0, 0.0)
    applied: Planar = (0.0, 0.0)
    latency_us: int | None = None


@dataclass(frozen=True, slots=True)
class CommandAck:
    """A twist was validated (accepted or rejected). It answers frame `seq`; `holder` holds the lease now."""

    sender: Holder
    seq: int
    compute_us: int
    holder: Holder | None


def packet_kind(packet: bytes) -> PacketKind:
    """Return the kind of a packet of this pipe."""
    return PacketKind(packet[0])


def pack_issued(seq: int, t_us: int, fingerprint: int) -> bytes:
    """Encode that a frame is about to be published."""
    return _ISSUED.pack(PacketKind.ISSUED, seq, t_us, fingerprint)


def unpack_issued(packet: bytes) -> tuple[int, int, int]:
    """Decode a packet of `pack_issued`: (seq, t_us, fingerprint)."""
    _, seq, t_us, fingerprint = _ISSUED.unpack(packet)
    return seq, t_us, fingerprint


def pack_motion(motion: RobotMotion) -> bytes:
    """Encode the current motion of the robot."""
    latency_us = -1 if motion.latency_us is None else motion.latency_us
    return _MOTION.pack(PacketKind.MOTION, *motion.pose, *motion.moving, *motion.applied, latency_us)


def unpack_motion(packet: bytes) -> RobotMotion:
    """Decode a packet of `pack_motion`."""
    _, x, y, yaw, linear, angular, applied_linear, applied_angular, latency_us = _MOTION.unpack(packet)
    latency = None if latency_us < 0 else latency_us
    return RobotMotion((x, y, yaw), (linear, angular), (applied_linear, applied_angular), latency)


def pack_command_ack(ack: CommandAck) -> bytes:
    """Encode the result of a validated twist."""
    return _ACK.pack(
        PacketKind.COMMAND_ACK, ack.seq, ack.compute_us, *_pack_holder(ack.sender), *_pack_holder(ack.holder)
    )


def unpack_command_ack(packet: bytes) -> CommandAck:
    """Decode a packet of `pack_command_ack`."""
    _, seq, compute_us, source, session, holder_source, holder_session = _ACK.unpack(packet)
    sender = _unpack_holder(source, session)
    if sender is None:
        raise ValueError("an ack has a sender")
    return CommandAck(sender, seq, compute_us, _unpack_holder(holder_source, holder_session))


def _pack_holder(holder: Holder | None) -> tuple[bytes, bytes]:
    return (holder.source.encode(), holder.session.encode()) if holder else (b"", b"")


def _unpack_holder(source: bytes, session: bytes) -> Holder | None:
    name = source.rstrip(b"\0").decode()
    return Holder(source=name, session=session.decode()) if name else None


def pack_counts(kind: PacketKind, counts: Mapping[str, int]) -> bytes:
    """Encode counts by name: REJECTED or FAULTS."""
    return bytes([kind]) + json.dumps(dict(counts)).encode()


def unpack_counts(packet: bytes) -> dict[str, int]:
    """Decode a packet of `pack_counts`. Raises ValueError for counts that a status cannot contain."""
    try:
        counts = json.loads(packet[1:])
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(counts, dict) or len(counts) > _MAX_COUNTS or not all(
        name.isascii() and len(name) <= _MAX_COUNTS and type(count) is int and 0 <= count < _MAX_COUNT
        for name, count in counts.items()
    ):
        raise ValueError("invalid counts")
    return counts


_MAX_COUNTS: Final = 64  # of names, and of their letters
_MAX_COUNT: Final = 1 << 32


def pack_token(token: str, is_present: bool) -> bytes:
    """Encode that the token of a driver appeared or ended."""
    return bytes([PacketKind.TOKEN, is_present]) + token.encode()


def unpack_token(packet: bytes) -> tuple[str, bool]:
    """Decode a packet of `pack_token`: (token, is_present)."""
    is_present, = packet[1:2]
    return packet[2:].decode(), bool(is_present)


def pack_message(kind: PacketKind, message: Message) -> bytes:
    """Encode an undecoded message of the wire: RAW or PUBLISH."""
    head = _PARTS.pack(kind, message.channel.name.encode(), message.source.encode(), len(message.header))
    return head + message.header + message.payload


def unpack_message(packet: bytes) -> Message:
    """Decode a packet of `pack_message`."""
    _, name, source, header_bytes = _PARTS.unpack_from(packet)
    start = _PARTS.size
    channel = CHANNELS[name.rstrip(b"\0").decode()]
    body = start + header_bytes
    return Message(channel, source.rstrip(b"\0").decode(), packet[start:body], packet[body:])


# Requests without room in the driver's socket: stored until there is room, STOP first. Pure.
#
# A twist without room is dropped, because a newer one follows. A request is not repeated, or is a STOP, so it waits.


MAX_PENDING: Final = 32
"""Security limit: requests that wait for room in the socket to the driver."""


# The network process's end of the pipe: both sockets, and the waiting requests. Shell.


class NetworkEnd:
    """The network process's end of the pipe. Only `receive` waits. Thread-safe."""

    def __init__(self, waited: socket.socket, aside: socket.socket) -> None:
        self._waited, self._aside = waited, aside
        self._pending_requests: OutgoingQueue[Message] = OutgoingQueue(MAX_PENDING)
        self._order = threading.Lock()
        self.dropped_commands = 0

    def receive(self) -> bytes:
        """Wait for the next packet without a limit. Returns b"" when the driver has closed its end."""
        try:
            return self._waited.recv(MAX_PACKET_BYTES)
        except OSError:
            return b""

    def motion(self, last: RobotMotion) -> RobotMotion:
        """Return the newest motion of the driver process, or `last` without a newer one."""
        with suppress(OSError):
            while packet := self._aside.recv(MAX_PACKET_BYTES, socket.MSG_DONTWAIT):
                last = unpack_motion(packet)
        return last

    def send(self, packet: bytes) -> bool:
        """Send a packet that wakes the driver. Returns False without room."""
        return _send_if_room(self._waited, packet)

    def send_aside(self, packet: bytes) -> bool:
        """Send a packet that the driver reads when it needs it. Returns False without room."""
        return _send_if_room(self._aside, packet)

    def forward(self, message: Message) -> None:
        """Send a command immediately, undecoded. Without room a request waits; a twist is dropped and counted.

        Next: `robot_side/driver/process.py`: `Driver.loop`.
        """
        with self._order:
            if self._pending_requests.flush(self._pass) and self._pass(message):
                return
            is_request = message.channel is REQUEST and request_verb(message.payload) is not None
            if not is_request or not self._pending_requests.put(message, message):
                self.dropped_commands += 1

    def retry(self) -> None:
        """Send the waiting requests while there is room."""
        if len(self._pending_requests):
            with self._order:
                self._pending_requests.flush(self._pass)

    def _pass(self, message: Message) -> bool:
        return self.send(pack_message(PacketKind.RAW, message))


def _send_if_room(end: socket.socket, packet: bytes) -> bool:
    try:
        end.send(packet, socket.MSG_DONTWAIT)
    except OSError:
        return False
    return True


# The driver's end of the pipe: start and restart the network process, and send packets without waiting. Shell.


_PACKETS_PER_WAKE = 64  # a flood is read in portions, so that no tick waits for its end
_PACKETS_ASIDE = 1024  # more than the socket holds, but a limit
_DRAIN_US = 500_000  # to read the packets of a dead process; a descendant may keep its end open
_FIRST_BACKOFF_US = 700_000  # the wheels are at zero before a peer can drive again
_LONGEST_BACKOFF_US = 2_000_000
_WEDGED_US = 2_000_000
_LONGEST_STEP_US = 40_000  # of the loop between two calls; the rest is a delay of this process
_STARTS_WITHIN_US = 30_000_000  # a first start reads its packages from a slow card
_END_S = 1.0
_FIRST_PATIENCE_US, _LONGEST_PATIENCE_US = 2_000_000, 60_000_000
CAMERA_EXIT: Final = 71
"""Exit code of a network process whose camera hangs or gives no image. A new process opens the camera again."""
_CHILD: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); "
    "from sightline.robot_side.network.process import main; main()"
)
"""It uses the module search path of the driver. The current folder is not first, because a file there may have the name
of a Python module, and no other copy of this package is found."""


class NetworkSetup(Config):
    """The first packet of the network process: its configuration."""

    config: RobotConfig
    session: SessionId
    first_seq: int
    is_restart: bool = False
    """True after a restart. The camera is then opened after the link, so that the robot remains reachable."""
    camera_fault: str = ""
    """Why the last process had no image."""
    camera_patience_us: int = _FIRST_PATIENCE_US
    """Time without an image after which the process ends with CAMERA_EXIT."""


class DriverEnd:
    """The driver's end of the pipe. No method waits for the network process, except `close`."""

    def __init__(self, config: RobotConfig, session: str, *, is_restart: bool = False) -> None:
        """Begin without a network process. After a restart of the driver process the robot had its endpoint open."""
        self._received = False
        self._silent_us = self._kept_us = 0
        self._hung = False
        self._config = config
        self._session = session
        self._process: subprocess.Popen[bytes] | None = None
        self.socket: socket.socket | None = None
        """Commands from the network process; acks and messages to it. The driver waits on it."""
        self._aside: socket.socket | None = None
        """Issued frames and the robot's motion. No process waits on it."""
        self._gone_us = 0
        self._start_at_us = 0
        self._backoff_us = _FIRST_BACKOFF_US
        self._was_ready, self._is_ready = is_restart, False
        self._camera_fault = ""
        self._camera_patience_us = _FIRST_PATIENCE_US
        self.restarts = -1
        self.exit_code = 0
        self.failed_at_start = False

    def keep_alive(self, now_us: int, first_seq: int) -> None:
        """Start the network process if it is not running and the backoff is over."""
        if self._process is not None and self._process.poll() is not None and self._is_read(now_us):
            self._on_exit(self._process.returncode, now_us)
        # Limited steps, so that a time in which this process did not run does not count.
        step_us, self._kept_us = min(now_us - self._kept_us, _LONGEST_STEP_US), now_us
        self._silent_us = 0 if self._received else self._silent_us + step_us
        self._received = False
        if self._process is not None and self._was_ready and self._silent_us > _WEDGED_US:
            self._hung = True  # or stopped: a running process reports five times a second
            self._process.kill()
        if self.is_start_due(now_us):
            self._silent_us, self._hung = -_STARTS_WITHIN_US, False
            try:
                self._start(first_seq)
            except OSError as error:
                _log.info("network process does not start: %s; trying again", error.strerror)
                self._start_at_us = now_us + _LONGEST_BACKOFF_US

    def is_start_due(self, now_us: int) -> bool:
        """Return True if `keep_alive` starts a process now. That waits until the child has a processor."""
        return self._process is None and now_us >= self._start_at_us and not self.failed_at_start

    def _start(self, first_seq: int) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        aside, their_aside = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ExitStack() as undo, ExitStack() as unmask, theirs, their_aside:
            for end in (ours, aside):
                undo.callback(end.close)
                end.setblocking(False)
            setup = NetworkSetup(
                config=self._config, session=self._session, first_seq=first_seq, is_restart=self._was_ready,
                camera_fault=self._camera_fault, camera_patience_us=self._camera_patience_us,
            )
            ours.send(setup.model_dump_json().encode())
            ends = (theirs.fileno(), their_aside.fileno())
            # The child inherits the mask, so that no signal interrupts its imports. Later it ignores these signals.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, EXIT_SIGNALS)
            unmask.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
            self._process = subprocess.Popen(_command(ends), pass_fds=ends, stdin=subprocess.DEVNULL)
            undo.pop_all()
        self.socket, self._aside, self._is_ready = ours, aside, False
        self.restarts += 1

    def _is_read(self, now_us: int) -> bool:
        """Return True when all packets of the dead process are read. The last one may be a STOP."""
        self._gone_us = self._gone_us or now_us
        return self.socket is None or now_us - self._gone_us >= _DRAIN_US

    def _on_exit(self, code: int, now_us: int) -> None:
        self._process, self._gone_us = None, 0
        self._close_sockets()
        if not self._was_ready:  # the process has reported the reason
            self.failed_at_start, self.exit_code = True, code if code > 0 else 1
            return
        if code == CAMERA_EXIT:  # later each time, because a restart also interrupts the link
            self._camera_patience_us = min(2 * self._camera_patience_us, _LONGEST_PATIENCE_US)
        why = "stopped or hung" if self._hung else "camera" if code == CAMERA_EXIT else code
        _log.info("network process ended (%s); starting it again", why)
        self._start_at_us = now_us + self._backoff_us
        self._backoff_us = min(2 * self._backoff_us, _LONGEST_BACKOFF_US)

    def on_ready(self) -> None:
        """Note that the endpoint of the process is open. From now on it is restarted after each end."""
        self._was_ready = self._is_ready = True
        self._backoff_us = _FIRST_BACKOFF_US

    def on_camera(self, fault: str) -> None:
        """Note why no image comes, or "" while images come."""
        self._camera_fault = fault
        if not fault:
            self._camera_patience_us = _FIRST_PATIENCE_US

    def send(self, packet: bytes) -> None:
        """Send a packet or drop it, because a network process that does not read must not slow the driver.

        A process that is still starting would publish an old status as new, so it receives nothing.
        """
        if self._is_ready:
            _send_or_drop(self.socket, packet)

    def send_aside(self, packet: bytes) -> None:
        """Send a packet that does not wake the network process, which reads it when it needs it."""
        _send_or_drop(self._aside, packet)

    def packets(self) -> Iterator[bytes]:
        """Yield a bounded number of packets, first those of `aside`."""
        arrived = list(self._arrived())
        for _ in range(_PACKETS_ASIDE):
            packet = _receive(self._aside) if self._aside else None
            if not packet:
                break
            yield packet
        self._received = self._received or bool(arrived)
        yield from arrived

    def _arrived(self) -> Iterator[bytes]:
        for _ in range(_PACKETS_PER_WAKE):
            packet = _receive(self.socket) if self.socket else None
            if packet:
                yield packet
            elif packet is None:
                return
            elif self.socket:  # the process is gone, and all its packets are read
                self.socket.close()
                self.socket = None

    def _close_sockets(self) -> None:
        for end in (self.socket, self._aside):
            if end:
                end.close()
        self.socket = self._aside = None

    def close(self) -> None:
        """End the network process: close its socket, and kill it if it does not end within a second."""
        self._close_sockets()
        if self._process is None:
            return
        deadline_s = time.monotonic() + _END_S
        while self._process.poll() is None and time.monotonic() < deadline_s:
            time.sleep(0.01)
        self._process.kill()
        self._process.wait()


def _command(ends: Sequence[int]) -> list[str]:
    folders = [one for one in sys.path if isinstance(one, str)]  # Python ignores other types in the list
    return [sys.executable, "-P", "-c", _CHILD, *map(str, ends), json.dumps(folders)]


def _send_or_drop(end: socket.socket | None, packet: bytes) -> None:
    if end:
        try:
            end.send(packet)
        except OSError:
            return


def _receive(end: socket.socket) -> bytes | None:
    """Return the next packet, None while no packet waits, or b"" after the last packet of a closed end."""
    for _ in range(2):
        try:
            return end.recv(MAX_PACKET_BYTES)
        except BlockingIOError:
            return None
        except OSError:  # unread packets of the driver cause one error first; packets of the process may follow
            continue
    return b""
