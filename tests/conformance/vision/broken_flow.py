"""Broken vision services: queues, silences, losses, reports, and robots in states they do not like. Pure."""

import json
from collections import deque

from sightline.conformance.vision.flow import BROKEN_STATUS
from sightline.protocol.channels import DETECTIONS, FRAME, REPORT
from sightline.protocol.codec import decode
from sightline.protocol.messages import MissionRequest
from sightline.protocol.spec.message_cases import packed
from sightline.vision_side.missions.registry import requested_mission
from sightline.vision_side.pipeline import Observation, PipelineAnswer
from tests.conformance.vision.broken import STANDING, BrokenVision, breaks
from tests.conformance.vision.broken_answers import PerSession
from tests.conformance.vision.fixture import CONFIG


class Queueing(BrokenVision):
    """Keeps frames its own way: `queue` holds what came and was not looked at."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        self.queue = deque(maxlen=30)
        self.link.subscribe(FRAME, self.arrives)

    def arrives(self, message):
        self.queue.append(message)

    def tick(self, now_us):
        taken = self.next()
        if taken is not None:
            self._frames.put(taken)
        super().tick(now_us)


@breaks("V-FLOW-09", "answers everything in turn")
class InTurn(Queueing):
    def next(self):
        return self.queue.popleft() if self.queue else None


@breaks("V-FLOW-02", "takes the oldest of a burst")
class OldestFirst(Queueing):
    def next(self):
        oldest = self.queue[0] if self.queue else None
        self.queue.clear()
        return oldest


@breaks("V-CAUS-07", "looks at an older one after the newest of a burst")
class LooksBack(Queueing):
    older = None

    def next(self):
        older, self.older = self.older, None
        if self.queue:
            older = None
        if len(self.queue) >= 10:
            self.older = self.queue[len(self.queue) // 2]
        self.queue.clear()
        return older


@breaks("V-FLOW-03", "works off a flood")
class Flooded(Queueing):
    frames = 0

    def arrives(self, message):
        self.frames += 1
        if self.frames == 800:
            self.busy_until_us = self.now_us + 3_000_000

    def next(self):
        return None


class Gaps(BrokenVision):
    """Measures how long no frame arrived before the current frame."""

    last_us = None

    def hears(self, header, jpeg):
        gap_us = 0 if self.last_us is None else self.now_us - self.last_us
        self.last_us = self.now_us
        return (header, jpeg) if self.likes(gap_us) else None


@breaks("V-FLOW-04", "is asleep after a second")
class Sleepy(Gaps):
    def likes(self, gap_us):
        return not 1_200_000 < gap_us < 1_700_000


@breaks("V-SIL-02", "is asleep after four seconds")
class Sleeper(Gaps):
    def likes(self, gap_us):
        return gap_us < 4_000_000


@breaks("V-FLOW-05", "tires of 30 frames a second")
class Tired(Gaps):
    steady = 0

    def likes(self, gap_us):
        self.steady = self.steady + 1 if 29_000 < gap_us < 41_000 or self.steady > 45 else 0
        return self.steady < 46


@breaks("V-FLOW-01", "is silent after an invalid JPEG")
class Silent(BrokenVision):
    def hears(self, header, jpeg):
        return None if jpeg.startswith(b"no picture") else (header, jpeg)


@breaks("V-FLOW-06", "is silent without a camera model")
class NeedsCamera(BrokenVision):
    def hears(self, header, jpeg):
        return None if self._pipeline is None else (header, jpeg)


@breaks("V-FLOW-07", "gives up on a late camera model")
class Impatient(BrokenVision):
    blind = 0

    def hears(self, header, jpeg):
        self.blind += self._pipeline is None
        return header, jpeg

    def _use(self, camera):
        if self.blind < 20:
            super()._use(camera)


@breaks("V-FLOW-08", "keeps its first picture size")
class FirstSize(BrokenVision):
    def _use(self, camera):
        if self._pipeline is None or camera.width_px == self._camera.width_px:
            super()._use(camera)


@breaks("V-SIL-03", "drives on when pictures cease")
class DrivesOn(BrokenVision):
    bad = 0

    def decides(self, header, answer):
        self.bad = self.bad + 1 if answer.twist is None and self.tiny else 0
        return STANDING if self.bad > 5 else answer

    def hears(self, header, jpeg):
        self.tiny = len(jpeg) == 4
        return header, jpeg


# --- states ----------------------------------------------------------------------------------------------------------


class Stately(BrokenVision):
    """Reads the status; `quiet` while it holds what this one does not like."""

    quiet, received_us = False, 0

    def on_status(self, message):
        self.received_us = self.now_us
        try:
            status = json.loads(message.payload)
        except ValueError:
            status = {}
        self.quiet = self.dislikes(status if isinstance(status, dict) else {}, message.payload)

    def decides(self, header, answer):
        return None if self.quiet else answer


def stately(case, wrong, dislikes):
    """Falls silent for a status."""
    kind = type("Stately", (Stately,), {"dislikes": lambda self, status, payload: dislikes(status, payload)})
    breaks(case, wrong)(kind)


stately("V-STAT-02", "is silent while the robot is stopped", lambda it, _: it.get("state") == "STOPPED")
stately("V-STAT-03", "stops answering after rejections", lambda it, _: it.get("refused", {}).get("STALE", 0) > 50)
stately("V-STAT-04", "is silent while another drives", lambda it, _: bool(it.get("holder")))
stately("V-STAT-05", "knows all fields of a status", lambda it, _: "battery" in it)
for _id, (_title, _payload) in BROKEN_STATUS.items():
    stately(_id, f"not so: {_title}", lambda _, payload, bad=_payload: payload == bad)


@breaks("V-STAT-01", "only acknowledges while the robot is disarmed")
class Waiting(Stately):
    def dislikes(self, status, payload):
        return status.get("state") == "DISARMED"

    def decides(self, header, answer):
        return PipelineAnswer(None, Observation("waiting")) if self.quiet else answer


@breaks("V-STAT-06", "needs a status every 300 ms")
class NeedsStatus(Stately):
    def dislikes(self, status, payload):
        return False

    def decides(self, header, answer):
        return answer if self.now_us - self.received_us < 300_000 else None


# --- connections -----------------------------------------------------------------------------------------------------


@breaks("V-RECO-01", "does not come back after a third of a second")
class GivesUp(BrokenVision):
    def back(self):
        self.dead = 200_000 < self.gap_us < 500_000


@breaks("V-RECO-02", "does not accept a robot that starts again after a second")
class OneRobot(PerSession):
    gone, deaf = False, False

    def back(self):
        self.gone = self.gap_us > 900_000

    def starts_anew(self):
        self.deaf = self.deaf or self.gone

    def decides(self, header, answer):
        answer = super().decides(header, answer)
        return None if self.deaf else answer


@breaks("V-RECO-03", "gives up when it has lost three connections")
class ThreeTimes(BrokenVision):
    losses = 0

    def lost(self):
        self.losses += 1
        self.dead = self.losses >= 3


@breaks("V-RECO-04", "counts from one for every connection")
class CountsPerConnection(BrokenVision):
    def back(self):
        self.answered = 0


@breaks("V-RECO-05", "delays answers until a client subscribes")
class KeepsBack(BrokenVision):
    kept = None

    def puts(self, fields, text, **how):
        if self.link.connected:
            super().puts(fields, text, **how)
        else:
            self.kept = (fields, text)

    def back(self):
        if self.kept is not None:
            super().puts(*self.kept)
            self.kept = None


class Reporting(BrokenVision):
    """Publishes reports and detections its own way."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        self.send_out = self.link.publish
        self.link.publish = self.publishes

    def publishes(self, channel, header, payload, source=""):
        changed = {REPORT: self.reports, DETECTIONS: self.finds}.get(channel)
        fields = None if changed is None else changed(json.loads(payload))
        if fields != {}:
            self.send_out(channel, header, payload if fields is None else packed(fields), source)

    def reports(self, fields):
        """Return what it reports instead; an empty object for nothing."""
        return fields

    def finds(self, fields):
        """Return the detections that it publishes instead."""
        return fields


@breaks("V-REP-01", "repeats its last report with each image")
class Talkative(Reporting):
    last = None

    def publishes(self, channel, header, payload, source=""):
        super().publishes(channel, header, payload, source)
        if channel is REPORT:
            self.last = (channel, header, payload, source)
        elif self.last is not None:
            self.send_out(*self.last)


@breaks("V-REP-02", "reports a new phase 0.4 s late")
class LatePhase(Reporting):
    phase, changed_us = "", 0

    def reports(self, fields):
        if fields["phase"] != self.phase:
            self.phase, self.changed_us = fields["phase"], self.now_us
        return fields if self.now_us - self.changed_us >= 400_000 else {}


@breaks("V-REP-03", "names its target in every fourth report")
class SeldomNamed(Reporting):
    count = 0

    def reports(self, fields):
        self.count += 1
        return fields | ({"target": None} if self.count % 4 else {})


@breaks("V-REP-04", "finds each object twice, with one number")
class Doubled(Reporting):
    def finds(self, fields):
        return fields | {"boxes": [box | {"track": 1} for box in fields["boxes"] * 2]}


@breaks("V-REP-05", "measures its boxes from the middle")
class FromTheMiddle(Reporting):
    def finds(self, fields):
        return fields | {"boxes": [box | {side: box[side] - 160 for side in ("x1_px", "x2_px")}
                                   for box in fields["boxes"]]}


@breaks("V-REP-06", "reports its target by a name of its own")
class OwnName(Reporting):
    def reports(self, fields):
        return fields | ({"target": fields["target"] | {"label": "cat"}} if fields.get("target") else {})


# --- missions --------------------------------------------------------------------------------------------------------


class Obedient(BrokenVision):
    """Starts a mission that it has to reject because of `reason`."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        requests = self._mission_channel._requests
        take = requests.take

        def obeys(message, frame, waited_us):
            chosen = take(message, frame, waited_us)
            if self.reason in requests.rejection:
                requests.rejection = ""
                chosen = requested_mission(decode(MissionRequest, message.payload), CONFIG)
            return chosen

        requests.take = obeys


for _id, _reason in (("V-REQ-02", "UNKNOWN_SOURCE"), ("V-REQ-03", "STALE"), ("V-REQ-04", "OTHER_SESSION")):
    breaks(_id, f"starts a mission despite {_reason}")(type("Obedient", (Obedient,), {"reason": _reason}))


@breaks("V-REQ-05", "starts a mission while the wheels turn")
class Hasty(BrokenVision):
    def hears(self, header, jpeg):
        if self._pipeline is not None:  # each session has a switch of its own
            self._pipeline._mission_switch._is_at_rest = lambda view: True
        return header, jpeg
