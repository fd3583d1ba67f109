"""A driver by script: answers each frame with one twist, citing it properly, until its fault is triggered. Shell."""

import secrets
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from sightline.operator_side.faults.ledger import GOOD, INJECTED, EventLog
from sightline.protocol.channels import FRAME, TWIST, key_for
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader, Twist
from sightline.protocol.transports.link import LatestSlot, Message
from sightline.protocol.transports.zenoh.link import ZenohLink, open_zenoh
from sightline.protocol.text import format_twist

if TYPE_CHECKING:
    from sightline.evaluation.faults.peer import PeerOptions

KEPT: Final = 256
WAIT_S: Final = 0.05


class Script:
    """What an attack works with: the link, the newest frame, everything sent so far."""

    def __init__(self, options: "PeerOptions", link: ZenohLink, ledger: EventLog) -> None:
        self.options, self.link = options, link
        self.session = secrets.token_hex(4)
        self.seq = 0
        self.sent: deque[tuple[bytes, bytes]] = deque(maxlen=KEPT)
        self.twist = Twist(linear_mps=options.linear_mps, angular_rad_s=options.angular_rad_s)
        self._ledger = ledger
        self._frames: LatestSlot[Message] = link.latest(FRAME)
        self._recording = options.recording.open("a") if options.recording and not options.fault else None

    def frame(self, wait_s: float = WAIT_S) -> FrameHeader | None:
        """The header of the newest frame not yet taken, waiting a little for one."""
        message = self._frames.take(wait_s)
        return decode(FrameHeader, message.header) if message else None

    def answer(self, frame: FrameHeader, **changes: object) -> AnswerHeader:
        """The header of a command that answers `frame`; `changes` falsify what it cites."""
        cited = {"session": frame.session, "seq": frame.seq, "t_us": frame.t_us, **changes}
        echo = Echo.model_validate({"channel": "frame", **cited})
        self.seq += 1
        return AnswerHeader(source=self.options.source, session=self.session, seq=self.seq, echo=echo)

    def drive(self, frame: FrameHeader, twist: Twist | None = None) -> None:
        """Send a good command."""
        header, text = encode(self.answer(frame)), format_twist(twist or self.twist)
        self.sent.append((header, text))
        if self._recording:
            self._recording.write(f"{header.hex()} {text.hex()}\n")
            self._recording.flush()
        self._ledger.note(GOOD, frame.t_us)
        self.link.publish(TWIST, header, text, self.options.source)

    def attack(self, header: AnswerHeader | bytes, text: bytes | None = None) -> None:
        """Send what must not move the wheels."""
        data = header if isinstance(header, bytes) else encode(header)
        self._ledger.note(INJECTED)
        self.link.publish(TWIST, data, format_twist(self.twist) if text is None else text, self.options.source)

    def injected(self) -> None:
        """Note that the fault was done in another way than by `attack`."""
        self._ledger.note(INJECTED)

    @property
    def key(self) -> str:
        """The exact key of this driver's twists."""
        return key_for(self.link.robot, TWIST, self.options.source)


def run_driver(options: "PeerOptions", pulled: threading.Event, ledger: EventLog) -> int:
    """Drive, then do what `options.fault` names, for ever or for `options.seconds`."""
    from sightline.operator_side.faults.attacks import ATTACKS

    end_s = time.monotonic() + options.seconds if options.seconds else float("inf")
    with open_zenoh(options.robot, connect=[options.endpoint], role=options.source, timeout_s=15) as link:
        script = Script(options, link, ledger)
        while not (pulled.is_set() and options.fault) and time.monotonic() < end_s:
            frame = script.frame()
            if frame is not None:
                script.drive(frame)
        if options.fault:
            ATTACKS[options.fault](script)
    return 0
