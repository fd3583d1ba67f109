"""Implement the legacy protocol as a peer codec, at both ends, with one slot for the driver. Pure.

All its clients have the source `guest`. Without the slot, the robot would mix the commands of two clients.
"""

from collections.abc import Callable, Hashable
from typing import Final, NamedTuple

from sightline.protocol.channels import ACK, DETECTIONS, FRAME, KEY_PREFIX, TWIST, Channel, key_for
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import GUEST, AnswerHeader, Detections, DetectionsHeader, Echo, FrameHeader
from sightline.protocol.text import format_twist, parse_twist
from sightline.protocol.transports.endpoints import LegacyOptions
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.websocket.framing import BAD_FRAMING, IncomingMessage, PeerError
from sightline.protocol.transports.websocket.legacy_text import (
    MAX_BOXES_BYTES,
    boxes_from_detections,
    decode_picture,
    detections_from_boxes,
    encode_picture,
    format_boxes,
    format_dashed,
    parse_boxes,
    parse_dashed,
    text_bound,
)

# Time without a valid command after which a driver loses the slot. Equal to the robot's lease.
DRIVER_SLOT_US: Final = 1_000_000


class DriverSlot:
    """The slot of the single driver of a link."""

    def __init__(self) -> None:
        self._driver = ""
        self._until_us = 0

    def claim(self, who: str, now_us: int) -> str:
        """Claim the slot for `who` after a valid command. Returns the driver, which is `who` if the slot was free."""
        if who == self._driver or now_us >= self._until_us:
            self._driver, self._until_us = who, now_us + DRIVER_SLOT_US
        return self._driver

    def leave(self, who: str) -> None:
        """Free the slot when `who` is gone."""
        if who == self._driver:
            self._driver, self._until_us = "", 0


# The legacy protocol at both ends of a WebSocket. Its clients have no header, token or session. Pure.


# Security limit: a text toward a robot. A twist above 64 bytes is counted, and does not close the connection.
MAX_COMMAND_TEXT_BYTES: Final = 256


class LegacyClient(NamedTuple):
    """A client of the legacy protocol, the slot that it shares with others, and the writer of log lines."""

    who: str
    driver_slot: DriverSlot
    log: Callable[[str], None]


class LegacyToVision:
    """The robot's end of the legacy protocol: base64 images out, `linear|angular` in, as source `guest`.

    Such a peer cannot acknowledge. Each of its answers also counts as the answer to the newest image that it received,
    so that it receives images at the rate of its own answers.
    """

    text = True
    wants: tuple[str, ...] = ()

    def __init__(self, robot: str, options: LegacyOptions, now_us: Callable[[], int], client: LegacyClient) -> None:
        """Create the codec. `now_us` reads a monotonic clock."""
        self._robot, self._options, self._now_us = robot, options, now_us
        self._who, self._driver_slot, self._log = client
        self._logged = ""
        self._sent: tuple[bytes, int] | None = None
        self._looked_at: tuple[bytes, bytes] | None = None
        self._answers = 0

    @property
    def form(self) -> Hashable:
        return self._options

    def subscribes_to(self, channel: Channel) -> bool:
        return channel is FRAME

    def write(self, message: Message) -> tuple[bytes, ...]:
        return (encode_picture(message.payload, self._options.newlines),)

    def note_sent(self, message: Message) -> None:
        self._sent = message.header, self._now_us()
        # The peer may have used any image since its last answer. With the oldest one the answer is never too young.
        if self._looked_at is None:
            self._looked_at = message.header, message.payload

    def read(self, message: str | bytes) -> list[IncomingMessage]:
        if isinstance(message, bytes):
            raise PeerError(BAD_FRAMING, 1003, "binary message; this port expects text: linear|angular")
        text = message.encode("utf-8", "surrogatepass")
        if self._options.boxes and (b"," in text or not text):
            return [self._detections(text), *self._acknowledgement()]
        return [self._twist(text), *self._acknowledgement()]

    def bound(self, _wanted_bytes: int, /) -> int:
        return MAX_BOXES_BYTES if self._options.boxes else MAX_COMMAND_TEXT_BYTES

    def note_gone(self) -> None:
        """Free the slot, so that another client may drive."""
        self._driver_slot.leave(self._who)

    def _twist(self, text: bytes) -> IncomingMessage:
        """Convert a twist. Other text stays unchanged: the robot rejects it and shows the reason in `status`."""
        try:
            twist = parse_dashed(text, self._options.swapped) if self._options.dashed else parse_twist(text)
        except WireError:
            return IncomingMessage(key_for(self._robot, TWIST, GUEST.source), b"", text)
        # Only a valid command claims the slot, so that a client with invalid text cannot stop the driver.
        self._claim_driver_slot()
        barred = format_twist(twist) if self._options.dashed else text
        return IncomingMessage(key_for(self._robot, TWIST, GUEST.source), b"", barred)

    def _claim_driver_slot(self) -> None:
        """Raise WireError if another client drives. Each new driver is logged once."""
        driver = self._driver_slot.claim(self._who, self._now_us())
        if driver != self._logged:
            self._logged = driver
            self._log(f"{self._who} drives" if driver == self._who else f"{self._who} only watches: {driver} drives")
        if driver != self._who:
            raise WireError(RejectReason.NOT_HOLDER, f"{driver} drives")

    def _detections(self, text: bytes) -> IncomingMessage:
        looked_at, self._looked_at = self._looked_at, None
        if looked_at is None:
            raise WireError(RejectReason.UNKNOWN_FRAME, "boxes without an image")
        found = detections_from_boxes(parse_boxes(text), read_jpeg_size(looked_at[1]))
        self._answers += 1
        echo = _echo(looked_at[0])
        header = DetectionsHeader(source=GUEST.source, session=GUEST.session, seq=self._answers, echo=echo)
        return IncomingMessage(key_for(self._robot, DETECTIONS, GUEST.source), encode(header), encode(found))

    def _acknowledgement(self) -> list[IncomingMessage]:
        sent, self._sent, self._looked_at = self._sent, None, None
        echo = _echo(sent[0]) if sent else None
        # Each image has one credit. A second answer to the same image returns none.
        if sent is None or echo is None:
            return []
        self._answers += 1
        # The share of computing in the answer time is unknown. All of it counts as computing, so that the congestion
        # window does not widen for a slow peer.
        spent_us = max(0, self._now_us() - sent[1])
        answer = AnswerHeader(
            source=GUEST.source, session=GUEST.session, seq=self._answers, echo=echo, compute_us=spent_us
        )
        return [IncomingMessage(key_for(self._robot, ACK, GUEST.source), encode(answer), b"")]


def _echo(header: bytes) -> Echo | None:
    """Return the echo of the frame with `header`, or None for a frame without a header."""
    try:
        frame = decode(FrameHeader, header)
    except WireError:
        return None
    return Echo.of(frame)


# Time without a newer command after which a legacy robot is stopped. Equal to the silence that a robot permits.
SILENCE_US: Final = 300_000
# A connection that ends within this time after a text was probably closed because of the text.
CLOSED_BY_TEXT_US: Final = 100_000
CLOSED_BY_TEXT: Final = 3
# Zeros after each motion.
_ZEROS: Final = 2


class LegacyCommands:
    """The commands to one legacy robot, over all connections. Two zeros follow each motion.

    Such a robot has no watchdog: it applies its last command forever.
    """

    def __init__(self, endpoint: str, options: LegacyOptions, log: Callable[[str], None]) -> None:
        """Create the record for the robot at `endpoint`. `log` writes a log line."""
        self._endpoint, self.options, self._log = endpoint, options, log
        self.zero = b"" if options.boxes else as_text(options, b"0.0000|0.0000")
        """The text that stops the robot."""
        # A link that never sent a command belongs to a viewer. It must not stop the robot of another driver.
        self._last: bytes | None = None
        self._last_us = self._zeros = self._closed_by_text = 0
        self._unreadable = ""

    def received(self, fault: str = "", fix: str = "it must send each image as base64 text and nothing else") -> None:
        """Note an image, or why a message is not an image. Logs the first of several faults in a row."""
        if fault and not self._unreadable:
            self._log(f"robot at {self._endpoint}: {fault}; {fix}")
        self._unreadable = fault

    def sent(self, text: bytes, now_us: int) -> None:
        """Record a command that is being sent."""
        self._last, self._last_us = text, now_us
        self._zeros = self._zeros + 1 if text == self.zero else 0

    def rest_due(self, now_us: int) -> bool:
        """Return True if a zero is due: the second one, or the first one after a silence or a lost connection."""
        if self._last is None or self._zeros >= _ZEROS:
            return False
        return self._zeros > 0 or now_us - self._last_us > SILENCE_US

    def farewell(self) -> tuple[bytes, ...]:
        """Return the last texts of a link that ends; empty if it never sent a command."""
        return () if self._last is None else (self.zero,) * _ZEROS

    def closed(self, now_us: int) -> None:
        """Note the end of a connection. It may log a text format that the robot could read."""
        last = self._last
        if last is None:
            return
        self._closed_by_text = self._closed_by_text + 1 if now_us - self._last_us <= CLOSED_BY_TEXT_US else 0
        if self._closed_by_text == CLOSED_BY_TEXT:
            self._closed_by_text = 0
            self._log(
                f"robot at {self._endpoint} closed {CLOSED_BY_TEXT} connections within {CLOSED_BY_TEXT_US // 1000} ms "
                f"after '{last.decode('ascii')}'; use the text format that it reads, probably {self._alternative(last)}"
            )
        # The robot may still apply its last command. Zero is due immediately after the next connection.
        self._zeros, self._last_us = 0, now_us - SILENCE_US - 1

    def _alternative(self, last: bytes) -> str:
        """Return the endpoint with a format that the robot may accept in place of `last`."""
        options, address = self.options, self._endpoint.partition("?")[0]
        if options.boxes or not options.dashed:
            return address if options.boxes else f"{address}?dashed"
        numbers = last.split(b"-")
        if options.nonnegative or len(numbers) == 2:
            return address
        return f"{address}?dashed{'&swapped' if options.swapped else ''}&nonnegative"


def as_text(options: LegacyOptions, twist: bytes) -> bytes:
    """Format the text of a twist by `options`."""
    return format_dashed(twist, options.swapped, options.nonnegative) if options.dashed else twist


class LegacyToRobot:
    """The vision service's end of the legacy protocol: base64 text in as frames, twists out as plain text.

    The codec creates the header of a frame. Its session is that of this connection, and `t_us` is the arrival time on
    the clock of this machine. The motion of the robot is unknown.
    """

    text = True
    wants: tuple[str, ...] = ()

    def __init__(
        self, robot: str, commands: LegacyCommands, now_us: Callable[[], int], session: str, max_frame_bytes: int
    ) -> None:
        """Create the codec. `session` is 8 hex digits, new for each connection. `now_us` reads a monotonic clock."""
        self._robot, self._commands, self._now_us = robot, commands, now_us
        self._options = commands.options
        self._session, self._max_frame_bytes = session, max_frame_bytes
        self._seq = 0
        self._last_us = -1

    @property
    def form(self) -> Hashable:
        return self._options

    def subscribes_to(self, channel: Channel) -> bool:
        return channel is (DETECTIONS if self._options.boxes else TWIST)

    def write(self, message: Message) -> tuple[bytes, ...]:
        if message.channel is DETECTIONS:
            found = decode(Detections, message.payload, DETECTIONS.max_payload_bytes)
            return (format_boxes(boxes_from_detections(found)),)
        return (as_text(self._options, message.payload),)

    def note_sent(self, message: Message) -> None:
        self._commands.sent(b"".join(self.write(message)), self._now_us())

    def note_gone(self) -> None:
        self._commands.closed(self._now_us())

    def read(self, message: str | bytes) -> list[IncomingMessage]:
        if isinstance(message, bytes):
            self._commands.received("its message is binary")
            raise PeerError(BAD_FRAMING, 1003, "binary message; the legacy protocol is text: base64 images")
        try:
            jpeg = decode_picture(message.encode("utf-8", "surrogatepass"), self._max_frame_bytes)
        except WireError as error:
            self._commands.received(error.detail)
            raise
        self._commands.received()
        self._seq += 1
        # Two messages of one read arrive in the same microsecond, but the time of a frame must rise.
        self._last_us = max(self._now_us(), self._last_us + 1)
        header = FrameHeader(session=self._session, seq=self._seq, t_us=self._last_us)
        return [IncomingMessage(f"{KEY_PREFIX}/{self._robot}/{FRAME.name}", encode(header), jpeg)]

    def bound(self, _wanted_bytes: int, /) -> int:
        return text_bound(self._max_frame_bytes)
