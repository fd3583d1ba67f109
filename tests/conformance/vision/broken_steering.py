"""Broken vision services: those that steer where they should not. Pure."""

import json

from sightline.conformance.vision.images import CAMERA
from sightline.protocol.channels import DETECTIONS
from sightline.protocol.messages import Twist
from sightline.vision_side.pipeline import Observation, PipelineAnswer
from tests.conformance.vision.broken import BrokenVision, breaks
from tests.conformance.vision.broken_answers import PerSession


class Steering(PerSession):
    """Changes speeds; `saw` holds what this session has shown."""

    def starts_anew(self):
        self.saw = set()

    def decides(self, header, answer):
        answer = super().decides(header, answer)
        if answer.twist is None or answer.seen.phase == "switching":  # it comes to rest, as it has to
            return answer
        bearing = answer.seen.bearing_rad
        beside = bearing is not None and abs(bearing) > 0.1
        self.saw.add("nothing" if bearing is None else "ahead" if not beside else "left" if bearing > 0 else "right")
        linear, angular = self.steers(answer.twist.linear_mps, answer.twist.angular_rad_s, bearing)
        return PipelineAnswer(Twist(linear_mps=linear, angular_rad_s=angular), answer.seen)


def steering(case, wrong):
    """Decorator of a function (vision, linear, angular, bearing) -> (linear, angular)."""
    def keep(steers):
        breaks(case, wrong)(type("Steering", (Steering,), {"steers": steers}))
    return keep


@steering("V-STEER-01", "never turns left")
def _(self, linear, angular, bearing):
    return linear, min(angular, 0.0)


@steering("V-STEER-02", "never turns right before it turned left")
def _(self, linear, angular, bearing):
    return linear, angular if "left" in self.saw else max(angular, 0.0)


@steering("V-STEER-03", "pulls to the left on the straight")
def _(self, linear, angular, bearing):
    return linear, angular + 0.5 if linear > 0 and abs(angular) < 0.1 else angular


@steering("V-STEER-04", "drives off to look for a target")
def _(self, linear, angular, bearing):
    return (0.2 if self.count > 20 and self.saw == {"nothing"} else linear), angular


@steering("V-STEER-05", "drives on where the target was")
def _(self, linear, angular, bearing):
    return (0.3 if bearing is None and "ahead" in self.saw else linear), angular


@steering("V-STEER-06", "turns left for ever once it did")
def _(self, linear, angular, bearing):
    return linear, abs(angular) if "left" in self.saw and self._camera == CAMERA else angular


@steering("V-STEER-09", "stops where it should drive forward")
def _(self, linear, angular, bearing):
    return min(linear, 0.0) if self.saw == {"ahead"} else linear, angular


@steering("V-STEER-10", "turns right whatever it sees")
def _(self, linear, angular, bearing):
    return 0.0, -0.5


@breaks("V-STEER-07", "takes time from its own clock")
class OwnClock(Steering):
    last_us = 0

    def steers(self, linear, angular, bearing):
        slow = self.now_us - self.last_us > 60_000
        self.last_us = self.now_us
        return linear * (0.9 if slow else 1.0), angular


@breaks("V-STEER-08", "remembers what the robot's last start saw")
class Remembers(Steering):
    before = frozenset()

    def starts_anew(self):
        self.before = frozenset(getattr(self, "saw", ()))
        self.saw = set()

    def steers(self, linear, angular, bearing):
        return (0.3 if bearing is None and self.count < 4 and "ahead" in self.before else linear), angular


@breaks("V-STEER-11", "measures from the middle of its first picture size")
class FirstMiddle(BrokenVision):
    first = None

    def _use(self, camera):
        self.first = self.first or camera
        resized = camera.width_px != self.first.width_px
        super()._use(camera.model_copy(update={"cx_px": self.first.cx_px}) if resized else camera)
        self._camera = camera


@breaks("V-STEER-12", "takes one camera model for each picture size")
class OneModelPerSize(BrokenVision):
    def _use(self, camera):
        if self._camera is None or camera.width_px != self._camera.width_px:
            super()._use(camera)


class SwappedAxes(BrokenVision):
    """Sends `angular|linear`; not in the table, since it fails each case about the axes."""

    def writes(self, fields, text):
        self.puts(fields, None if text is None else b"|".join(reversed(text.split(b"|"))))


BY_BOXES = Observation("by boxes")


class Boxes(BrokenVision):
    """Steers by the boxes of `detector` as soon as some come in a session, and only acknowledges frames then."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        self.frames, self.newest, self.steered, self.session = {}, None, -1, ""
        self.link.subscribe(DETECTIONS, self.on_boxes)

    def decides(self, header, answer):
        if answer.seen is BY_BOXES:
            return answer
        self.newest = self.frames[header.seq] = header
        return PipelineAnswer(None, answer.seen) if header.session == self.session else answer

    def on_boxes(self, message):
        echo = json.loads(message.header).get("echo")
        box = json.loads(message.payload)["boxes"][0]
        left_px = CAMERA.cx_px - (box["x1_px"] + box["x2_px"]) / 2
        self.steered = self.steered if self.newest.session == self.session else -1
        self.session = self.newest.session
        frame = self.cited(echo, self.frames.get(echo["seq"]) if echo else None)
        if frame is not None:
            self.steered = frame.seq
            self._publish(frame, PipelineAnswer(Twist(linear_mps=0, angular_rad_s=left_px / 200), BY_BOXES), 0)

    def cited(self, echo, frame):
        """Return the header of the frame that a twist by boxes cites; None to reject the boxes."""
        return frame if frame is not None and frame.seq > self.steered else None


@breaks("V-STEER-13", "cites the newest frame for boxes of an older one")
class CitesNewest(Boxes):
    def cited(self, echo, frame):
        return self.newest if super().cited(echo, frame) else None


@breaks("V-STEER-14", "takes boxes without an echo for those of the newest frame")
class NeedsNoEcho(Boxes):
    def cited(self, echo, frame):
        return super().cited(echo, frame) if echo else self.newest


@breaks("V-STEER-15", "takes boxes of an unknown frame for those of the newest")
class KnowsAllFrames(Boxes):
    def cited(self, echo, frame):
        return self.newest if echo and frame is None else super().cited(echo, frame)


@breaks("V-STEER-16", "goes back to the boxes of an older frame")
class GoesBack(Boxes):
    def cited(self, echo, frame):
        return frame
