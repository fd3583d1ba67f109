"""Broken vision services, one per case: the reference with one step changed. Pure.

`BROKEN` maps a case's id to (what is wrong, the class). `test_cases.py` demands that it fails that case
and no other. The steps that a broken one may change, in the order of a frame's way, are the methods of `BrokenVision`.
"""

from sightline.conformance.vision.images import HALF_CAMERA
from sightline.protocol.channels import ACK, FRAME, STATUS, TWIST, key_for
from sightline.protocol.messages import STILL, FrameHeader
from sightline.protocol.spec.message_cases import packed
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import Message
from sightline.vision_side.pipeline import Observation, PipelineAnswer, answer_header
from tests.conformance.vision.fixture import COMPUTE_US, VirtualVision

BROKEN = {}
STANDING = PipelineAnswer(STILL, Observation("broken"))
"""A twist where the answer should have no twist."""


def breaks(case, wrong):
    """Class decorator: this one fails `case`."""
    def keep(kind):
        assert case not in BROKEN, case
        BROKEN[case] = (wrong, kind)
        return kind
    return keep


class BrokenVision(VirtualVision):
    """Nothing is broken yet."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        self.dead = False
        self.busy_until_us = 0
        self.was_connected, self.lost_at_us, self.gap_us = True, 0, 0
        self.status = {}
        self.link.subscribe(STATUS, self.on_status)

    # --- in ---

    def tick(self, now_us):
        self.now_us = now_us
        self._watch_connection()
        if not self.dead and now_us >= self.busy_until_us:
            self.turn(0.0)
            self.idle()

    def _watch_connection(self):
        connected = self.link.connected
        if connected and not self.was_connected:
            self.gap_us = self.now_us - self.lost_at_us
            self.back()
        if not connected and self.was_connected:
            self.lost_at_us = self.now_us
            self.lost()
        self.was_connected = connected

    def lost(self):
        """The kit's link is gone."""

    def back(self):
        """The link is up again; `gap_us` shows how long it was down."""

    def idle(self):
        """After each turn."""

    def on_status(self, message):
        """Each status as it comes."""

    def believes(self, message):
        """Return whether to use the small camera because of this camera message."""
        return False

    def _look_at_camera(self):
        message = self._cameras.take()
        if message is not None and self.believes(message):
            self._use(HALF_CAMERA)
        elif message is not None:
            self._cameras.put(message)
            super()._look_at_camera()

    def hears(self, header, jpeg):
        """The frame that is taken instead, as (header, jpeg); None for none."""
        return header, jpeg

    def _frame(self, message, started_ns):
        taken = self.hears(message.header, message.payload)
        if taken is not None:
            super()._frame(Message(FRAME, "", *taken), started_ns)

    # --- out ---

    def decides(self, header, answer):
        """The answer that is given instead; None for none."""
        return answer

    def _publish(self, header, answer, compute_us):
        answer = self.decides(header, answer)
        if answer is not None:
            self.answered += 1
            fields = answer_header(header, self.sender.session, self.answered, COMPUTE_US).model_dump(mode="json")
            self.writes(fields, None if answer.twist is None else format_twist(answer.twist))

    def writes(self, fields, text):
        """Send the answer; `text` is None for an ack."""
        self.puts(fields, text)

    def puts(self, fields, text, *, source="vision", payload=None, before=b"", after=b""):
        channel = ACK if text is None else TWIST
        if text is not None:
            fields = fields | self.sender.proofs.next()._asdict()
        self.network.put(key_for("r1", channel, source), before + packed(fields) + after,
                         (text or b"") if payload is None else payload, self.link)


def header_of(fields):
    """A frame's header from whatever is known of it."""
    return packed({name: fields[name] for name in ("session", "seq", "t_us")} | {"v": 1})


def frame_header(header):
    return FrameHeader.model_validate_json(header)


