"""The detector service over a link in memory: its messages, drops and counts for every answer of the detector."""

import signal
import threading
import time
from contextlib import nullcontext
from dataclasses import replace

import pytest

from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import Detections, FrameHeader
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.tokens import DriverToken, RobotToken, VisionToken
from sightline.vision_side.config import HsvConfig, VisionConfig
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.filters import LabelFilter
from sightline.vision_side.detect.port import Circle, Detection, Maker, result_of
from sightline.vision_side.serving import detector_sharing
from sightline.vision_side.serving.detector_service import DetectorService, ServingOptions, _BatchDecoder, run
from sightline.vision_side.serving.detector_sharing import Duty
from tests.fixtures.links import until
from tests.fixtures.vision.remote import BALL_JPEG, GREY_JPEG

HSV = Hsv(Hsv.Config(hsv=HsvConfig()))
GOOD = Detection(10.0, 10.0, 50.0, 50.0, 0.9, "ball")
LONGEST = Detection(10.123456789012345, 11.123456789012345, 312.1234567890123, 232.1234567890123, 0.12345678901234567,
                    "\N{LARGE YELLOW CIRCLE}" * 64, Circle(-1.2345678901234567, 120.12345678901235, 1.2345678901234567),
                    track_id=2**53 - 1)


class Named:
    """A detector that returns the detections in `found` or raises its exception, and returns `notices` once."""

    def __init__(self, *found, **changes):
        self.found, self.changes, self.lines = found, changes, []

    def detect(self, frames, deadline_us):
        if self.found and isinstance(self.found[0], Exception):
            raise self.found[0]
        return [replace(result_of(one, self.found, Maker("named", device="cpu")), **self.changes) for one in frames]

    def notices(self):
        lines, self.lines = self.lines, []
        return lines


class Bench:
    """A robot, and the service that looks at its frames."""

    connected = True

    def __init__(self, detector, **serving):
        self.network, self.words, self.seq, self.present = MemoryNetwork(seed=31), [], 0, ["r1"]
        self.watches = []
        """What receives the tokens of robots."""
        self.robot = self.network.link("r1")
        self.heard = self.robot.latest(DETECTIONS)
        serving = {"deadline_us": 5_000_000, **serving}  # a machine that halts for a moment makes no answer late
        self.service = DetectorService(self, detector, ServingOptions("named", **serving), self.words.append)

    def robots(self):
        return self.present

    def watch_detectors(self, _group, _callback):
        return lambda: None

    def watch_tokens(self, callback):
        self.watches.append(callback)
        return lambda: self.watches.remove(callback)

    def declare_token(self, _token):
        return lambda: None

    def on_new_robot(self, callback):
        self.ring = callback

    def link(self, robot):
        return self.network.link(robot, role="detector")

    def send(self, robot, jpeg=BALL_JPEG):
        """Let a robot send one more frame."""
        self.seq += 1
        robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=self.seq, t_us=self.seq)), jpeg)
        self.network.advance(self.network.now_us + 1)

    def turn(self):
        """Let the service look around, and serve one batch."""
        self.service._look_around()
        self.service._serve_batch()

    def look(self, jpeg=BALL_JPEG):
        """Return the service's answer to one more frame; None without an answer."""
        self.turn()
        self.send(self.robot, jpeg)
        self.turn()
        self.network.advance(self.network.now_us + 1)
        message = self.heard.take()
        return message and decode(Detections, message.payload, DETECTIONS.max_payload_bytes)

    def tally(self):
        return self.service.counters()["r1"]


def test_rejected_request_adds_no_load_and_each_reason_is_logged_once():
    named = Named(GOOD)
    bench = Bench(named)
    assert bench.look() is not None
    named.found = (ValueError("out of memory"),)
    for _ in range(30):
        assert bench.look() is None
    named.found, named.changes = (GOOD,), {"device": "d" * 100}
    for _ in range(30):
        assert bench.look() is None
    told = [line for line in bench.words if "receives the frames" not in line]
    assert len(told) == 2 and "out of memory" in told[0] and "cannot be sent" in told[1]
    bench.service._check_load(1e9)
    assert bench.tally().rejected == 60 and "overloaded" not in bench.service.about() and len(bench.words) == 3


@pytest.mark.parametrize("floods", ["r1", "r2"])
def test_overload_line_names_the_robot_that_sends_the_most_frames_now(floods):
    bench = Bench(Named(GOOD))
    bench.present = ["r1", "r2"]
    bench.turn()
    robots = {"r1": bench.robot, "r2": bench.network.link("r2")}
    for _ in range(20):  # earlier frames of the other robot do not count
        bench.send(next(link for robot, link in robots.items() if robot != floods))
        bench.turn()
    bench.service._check_load(1e9)
    for robot, link in robots.items():
        for _ in range(15 if robot == floods else 1):
            bench.send(link)
    bench.turn()
    bench.service._check_load(2e9)
    line = bench.words[-1]
    assert line == f"detector: overloaded: 2 answered, 14 dropped in 5 s, most frames from {floods} (15)"


def test_a_robot_that_left_is_forgotten_and_its_frames_stay_in_the_totals():
    bench = Bench(Named(GOOD))
    assert bench.look() is not None
    bench.service._check_load(1e9)
    bench.present = []
    assert bench.look() is None
    assert bench.service.counters() == {} and bench.words[-1] == "detector: r1 left"
    bench.service._check_load(2e9)
    assert "0 robots, 1 frames answered, 0 dropped" in bench.service.about() and "overload" not in bench.service.about()
    bench.present = ["r1"]
    assert bench.look() is not None and bench.tally().served == 1
    assert "1 robots, 2 frames answered" in bench.service.about()


def test_number_of_logged_reasons_is_bounded():
    named = Named()
    bench = Bench(named)
    for number in range(100):
        named.found = (ValueError(f"failure {number}"),)
        bench.look()
    assert 4 < len(bench.words) < 20


def test_an_answer_that_is_too_long_for_the_wire_loses_its_last_boxes_and_ends_nothing():
    bench = Bench(Named(*[LONGEST] * 64))
    said = bench.look()
    assert said is not None and 50 < len(said.boxes) < 64 and said.boxes[0].label == LONGEST.label
    assert bench.look() is not None and bench.tally().served == 2


@pytest.mark.parametrize(("detector", "why"), [
    (Named(replace(GOOD, label="")), "label"), (Named(replace(GOOD, label="a\x1b[2J")), "label"),
    (Named(replace(GOOD, label="\ud800")), "label"), (Named(replace(GOOD, circle=Circle(1.0, 1.0, 0.0))), "radius"),
    (Named(replace(GOOD, track_id=-1)), "track"), (Named(GOOD, detector="d" * 65), "detector"),
    (Named(GOOD, device="d" * 33), "device"), (Named(GOOD, model_hash="h" * 65), "model"),
    (Named(*[GOOD] * 65), "65 boxes"), (Named(RuntimeError("out of memory")), "out of memory"),
])
def test_value_beyond_the_wire_is_counted_and_logged_once(detector, why):
    bench = Bench(detector)
    assert bench.look() is None and bench.look() is None
    assert (bench.tally().rejected, bench.tally().served) == (2, 0)
    (line,) = [one for one in bench.words if "receives the frames" not in one]
    assert why in line and line.startswith("detector: ") and "\n" not in line


def test_notices_of_the_detector_are_logged_at_the_start_and_on_change():
    detector = Named(GOOD)
    detector.lines = ["m.onnx runs on cpu: no GPU runtime is installed"]
    bench = Bench(LabelFilter(detector, ("ball",)))
    bench.turn()
    assert bench.words[0] == "detector: m.onnx runs on cpu: no GPU runtime is installed"
    detector.lines = ["no answer: LATE"]
    bench.look()
    assert "detector: no answer: LATE" in bench.words


def test_model_and_device_are_known_before_the_first_frame():
    known = Named()
    known.maker = Maker("named", "0123456789abcdef", "cuda")
    assert Bench(LabelFilter(known, ("ball",))).service.about().startswith("named 01234567 on cuda: ")
    assert Bench(Named()).service.about().startswith("named: ")
    assert Bench(HSV).service.about().startswith("named on cpu: ")


class Late:
    """Gives no answer, or one, after the deadline."""

    def __init__(self, answers):
        self.answers = answers

    def detect(self, frames, deadline_us):
        time.sleep(max(0, deadline_us - monotonic_us()) / 1e6 + 0.001)
        return [result_of(one, (), Maker("late")) if self.answers else None for one in frames]


@pytest.mark.parametrize("answers", [True, False])
def test_answer_after_the_deadline_is_late_and_not_rejected(answers):
    bench = Bench(Late(answers), deadline_us=500_000)
    assert bench.look() is None
    assert (bench.tally().late, bench.tally().rejected) == (1, 0)


class Partial:
    """A detector that uses pixels, remembers which images were decoded before, and fails on the frames of one robot."""

    def __init__(self, failing=""):
        self.failing, self.decoded, self.batches, self.seqs, self.slow = failing, [], [], [], threading.Event()

    def detect(self, frames, deadline_us):
        self.batches.append([one.robot for one in frames])
        self.decoded += [one.decoded is not None for one in frames]
        self.seqs += [one.header.seq for one in frames]
        if any(one.robot == self.failing for one in frames):
            raise RuntimeError(f"cannot bear {self.failing}")
        for one in frames:
            one.picture()
        if self.slow.is_set():
            time.sleep(0.02)
        return [result_of(one, (GOOD,), Maker("partial")) for one in frames]


def test_failure_on_the_frame_of_one_robot_costs_no_other_robot_its_answer():
    bench = Bench(Partial("r1"))
    others = [bench.network.link(name) for name in ("r2", "r3")]
    heard = [link.latest(DETECTIONS) for link in (bench.robot, *others)]
    bench.present = ["r1", "r2", "r3"]
    bench.turn()
    for link in (bench.robot, *others):
        bench.send(link)
    bench.turn()
    bench.network.advance(bench.network.now_us + 1)
    assert [slot.take() is not None for slot in heard] == [False, True, True]
    assert [bench.service.counters()[name].rejected for name in ("r1", "r2", "r3")] == [1, 0, 0]


def test_images_are_decoded_before_the_detector_needs_them():
    detector = Partial()
    bench = Bench(detector)
    for _ in range(3):
        assert bench.look() is not None
    assert detector.decoded == [False, True, True], "a detector that uses no pixels costs no decoding"
    assert bench.look(BALL_JPEG[:700]) is None and bench.tally().rejected == 1 and len(detector.decoded) == 3


def test_detector_without_use_of_pixels_costs_no_decoding():
    bench = Bench(Named(GOOD))
    for _ in range(3):
        assert bench.look(BALL_JPEG[:700]) is not None


def test_pixels_of_a_batch_stay_while_the_next_one_is_decoded():
    """A detector on another thread may still look at them."""
    pixels, header = _BatchDecoder(320 * 240), FrameHeader(session="0000abcd", seq=1, t_us=1)
    frames = []
    for jpeg in (BALL_JPEG, GREY_JPEG, BALL_JPEG):
        pixels.next_batch()
        frames.append(pixels.frame("r1", header, jpeg, (320, 240)))
        before = frames[-2].picture().bgr.copy() if len(frames) > 1 else None
        frames[-1].picture()
        assert before is None or (frames[-2].picture().bgr == before).all()
    assert frames[0].picture().bgr is frames[2].picture().bgr, "two batches have pixels, and no more"
    assert all(one.looks_once for one in frames), "a second run would delay the other robots"


def test_two_batches_are_in_progress_and_a_slow_detector_gets_the_newest_frames():
    detector = Partial()
    bench = Bench(detector)
    bench.present = ["r1", "r2"]
    other, over = bench.network.link("r2"), threading.Event()
    detector.slow.set()
    thread = threading.Thread(target=bench.service.serve, args=(over,), daemon=True)
    thread.start()
    assert until(lambda: len(bench.words) == 2)
    sent = 0
    while len(detector.batches) < 8:
        bench.send(bench.robot)
        bench.send(other)
        sent += 1
        time.sleep(0.002)
    over.set()
    thread.join(5)
    assert not thread.is_alive()
    tally = bench.service.counters()
    assert all(one.overtaken > one.served >= 2 and one.late == 0 for one in tally.values()), (sent, tally)
    assert abs(tally["r1"].served - tally["r2"].served) <= 1
    assert len(detector.seqs) == len(set(detector.seqs)), "each frame is examined once"


def test_batch_that_waited_too_long_is_counted_and_not_examined():
    detector = Partial()
    bench = Bench(detector)
    bench.turn()
    bench.send(bench.robot)
    batch = bench.service._prepare()
    batch.frames[:] = [replace(one, arrived_us=one.arrived_us - 5_000_000) for one in batch.frames]
    bench.service._examine(bench.service._begin(batch)[0])
    assert len(batch.frames) == 1 and detector.batches == [] and bench.tally().stale == 1


def test_failure_on_the_thread_that_prepares_ends_the_service_with_its_error(monkeypatch):
    detector, bench = Partial(), None

    def fail():
        if threading.current_thread().name == "prepare":
            raise ZeroDivisionError
        for link in (bench.robot, other):
            bench.send(link)
        return prepare()

    detector.slow.set()
    bench = Bench(detector)
    bench.present, other = ["r1", "r2"], bench.network.link("r2")
    bench.turn()
    prepare = bench.service._prepare
    monkeypatch.setattr(bench.service, "_prepare", fail)
    with pytest.raises(ZeroDivisionError):
        bench.service.serve(threading.Event())


@pytest.mark.parametrize("weight", [None, 1.0])
def test_service_that_shares_subscribes_to_no_status(monkeypatch, weight):
    """It finds robots by their tokens: the statuses of 5,000 robots are 50,000 messages a second."""
    opened = {}

    def open_fleet(_pattern, **options):
        opened.update(options)
        raise LinkError("no network")

    monkeypatch.setattr("sightline.protocol.transports.zenoh.link.open_fleet", open_fleet)
    with pytest.raises(LinkError):
        run(VisionConfig(), Named(GOOD), ServingOptions("named", weight=weight))
    assert opened["by_status"] is (weight is None)


@pytest.mark.parametrize("weight", [None, 1.0])
@pytest.mark.parametrize(("connect", "ready"), [(("tcp/127.0.0.1:1",), [True, False, True]), ((), [True, True, True])])
def test_service_is_ready_once_it_is_warm_while_its_session_is_open_and_until_it_ends(
    monkeypatch, weight, connect, ready
):
    bench, found = Bench(Named(GOOD)), []
    monkeypatch.setattr("sightline.protocol.transports.zenoh.link.open_fleet", lambda *_, **__: nullcontext(bench))
    assert not bench.service.is_ready(), "not warm"

    def observe(service):
        found.append(service)
        for bench.connected in (True, False, True):
            found.append(service.is_ready())
        monkeypatch.setattr(service, "_look_around", end)

    def end():
        signal.raise_signal(signal.SIGTERM)
        found.append(found[0].is_ready())

    options = ServingOptions("named", weight=weight)
    assert run(VisionConfig(connect=connect), Named(GOOD), options, observe) == 0
    assert found[1:] == [*ready, False], "it ends"
    monkeypatch.setattr("sightline.vision_side.serving.detector_service.LIVE_S", -1.0)
    found[0]._ending.clear()
    assert not found[0].is_ready(), "it hangs"


@pytest.mark.parametrize(("robots", "looks"), [(0, [False, True, True]), (5_000, [False, False, True])])
def test_looks_at_many_robots_leave_time_for_their_frames(monkeypatch, robots, looks):
    bench, found = Bench(Named(GOOD)), []
    bench.service._changed.clear()
    bench.service._duties = dict.fromkeys(map(str, range(robots)), Duty.NOTHING)
    monkeypatch.setattr(bench.service, "_look_around", lambda: found.append(True))
    for after_s, is_due in zip((0.019, 0.099, 0.121), looks, strict=True):
        bench.service._looked_s = 100.0
        bench.service._look_if_due(100.0 + after_s)
        assert bool(found) is is_due
        found.clear()
    bench.ring()
    bench.service._look_if_due(bench.service._looked_s)
    assert found, "as soon as one comes"


def test_tokens_of_robots_that_did_not_fit_are_watched_again_in_place_of_the_first_watch(monkeypatch):
    monkeypatch.setattr(detector_sharing, "MAX_ROBOTS", 2)
    monkeypatch.setattr(detector_sharing, "LEFT_US", 0)
    bench = Bench(Named(GOOD))
    bench.service.join(1.0, "*")
    first, = bench.watches
    others = VisionToken("a", 1.0, "0000000a"), DriverToken("r9", "a", "0" * 32)
    for token in (*others, *map(RobotToken, ("r1", "r2", "r3"))):
        first(token, True)
    bench.service._look_around()
    assert set(bench.service._duties) == {"r1", "r2"} and bench.watches == [first]
    first(RobotToken("r1"), False)
    bench.service._look_around()
    again, = bench.watches
    assert again is not first and set(bench.service._duties) == {"r2"}
    monkeypatch.setattr(detector_sharing, "LEFT_US", 60_000_000)
    bench.service._look_around()
    assert set(bench.service._duties) == {"r2"} and bench.watches == [again], "none has left meanwhile"
    again(RobotToken("r3"), True)
    bench.service._look_around()
    assert set(bench.service._duties) == {"r2", "r3"}
