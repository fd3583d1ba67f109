"""Tests of the cases for vision services: ours passes; tests/conformance/mutants runs the broken ones."""

from collections.abc import Sequence

import pytest

from sightline.conformance.benches import TO_ROBOT, VirtualBench
from sightline.conformance.case import Access, Level
from sightline.conformance.codec import CASES as CODEC_CASES
from sightline.conformance.robot.cases import CASES as ROBOT_CASES
from sightline.conformance.runner import Outcome, passed, run_case
from sightline.conformance.vision.cases import CASES, is_there, prepare
from sightline.conformance.vision.fixture import RobotPlayed
from sightline.protocol.channels import FRAME, STATUS
from sightline.protocol.codec import decode
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import FrameHeader, Stamp
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.websocket.framing import pack
from sightline.vision_side.pipeline import Observation, PipelineAnswer
from tests.conformance.clauses import UNTESTED, clauses
from tests.conformance.vision import broken_answers as vision_broken_answers  # noqa: F401
from tests.conformance.vision import broken_flow as vision_broken_flow
from tests.conformance.vision import broken_inputs as vision_broken_inputs  # noqa: F401
from tests.conformance.vision import broken_steering as vision_broken_steering
from tests.conformance.vision.broken import BROKEN, BrokenVision
from tests.conformance.vision.fixture import BY_BOXES, KEYS, VirtualVision, reference, virtual_bench

pytestmark = pytest.mark.computes

VIRTUAL = [case for case in CASES if not case.real]


def result_of(case, vision):
    """A bench of its own for each: nothing is left from the case before."""
    return run_case(case, virtual_bench(vision), prepare)


@pytest.mark.parametrize("case", VIRTUAL, ids=lambda case: case.id)
def test_the_reference_conforms(case):
    result = result_of(case, reference(case.id))
    assert (result.outcome, result.reason) == (Outcome.PASSED, "")


@pytest.mark.parametrize("cases", [VIRTUAL[::10], pytest.param(VIRTUAL, marks=pytest.mark.slow)], ids=["some", "all"])
def test_a_broken_vision_of_which_nothing_is_broken_conforms(cases):
    outcomes = {case.id: result_of(case, BrokenVision).outcome for case in cases}
    left = {name for name, outcome in outcomes.items() if outcome is not Outcome.PASSED}
    assert left == set(BY_BOXES) & set(outcomes)


class SendsTwice(VirtualVision):
    """Sends each twist twice, as clause 7.1 recommends while frames are lost. The second one comes a moment later."""

    copies: Sequence[tuple[object, ...]] = ()

    def tick(self, now_us):
        copies, self.copies = self.copies, []
        for copy in copies:
            super()._publish(*copy)
        super().tick(now_us)

    def _publish(self, *answer):
        super()._publish(*answer)
        self.copies = [*self.copies, answer]


class SlowVision(VirtualVision):
    """Takes some time for each image, and then at once the newest frame."""

    LOOK_US = 0
    looked = None

    def tick(self, now_us):
        self.now_us = now_us
        if self.looked is not None and now_us >= self.looked[0]:
            super()._publish(*self.looked[1:])
            self.looked = None
        if self.looked is None:
            super().tick(now_us)

    def _publish(self, *answer):
        self.looked = (self.now_us + self.LOOK_US, *answer)


PACED = [case for case in VIRTUAL if case.id in ("V-FLOW-05", "V-SEQ-05", "V-STAT-01", "V-STAT-06", "V-CAUS-14")]
FIRST = [case for case in VIRTUAL if case.id in ("V-FRAM-01", "V-FRAM-19", "V-FRAM-20", "V-FLOW-06", "V-LIM-32")]
"""Cases whose first frame comes right after the preparation, or after an image that may not keep the service busy."""
MUST = [case for case in VIRTUAL if case.level is Level.MUST]


@pytest.mark.parametrize("look_us", [60_000, 150_000, 260_000, 350_000])
@pytest.mark.parametrize("cases", [PACED, FIRST, pytest.param(MUST, marks=pytest.mark.slow)],
                         ids=["paced", "first", "all"])
def test_vision_service_with_a_slow_detector_fails_no_must_case(cases, look_us):
    slow = type("Slow", (SlowVision,), {"LOOK_US": look_us})
    results = [result_of(case, slow) for case in cases]
    assert [(one.case.id, one.reason) for one in results if one.outcome is Outcome.FAILED] == []


class WithoutProcessor(VirtualVision):
    """Gets no processor for 0.7 s after one answer, and answers no frame that a newer one replaced (7.1)."""

    count = paused_us = 0
    last = 20

    def tick(self, now_us):
        if now_us >= self.paused_us:
            super().tick(now_us)

    def _publish(self, *answer):
        super()._publish(*answer)
        self.count += 1
        self.paused_us = self.now_us + 700_000 if self.count == self.last else 0


@pytest.mark.parametrize(("name", "last"), [("V-FLOW-05", 20), ("V-STAT-01", 5), ("V-STAT-02", 5), ("V-STAT-13", 5)])
def test_vision_service_that_replaces_frames_while_it_has_no_processor_passes(monkeypatch, name, last):
    monkeypatch.setattr(WithoutProcessor, "last", last)
    result = result_of(next(case for case in VIRTUAL if case.id == name), WithoutProcessor)
    assert (result.outcome, result.reason) == (Outcome.PASSED, "")


class Loaded(BrokenVision):
    """Answers its 13th to 30th image 60 ms later, while other programs have the processor."""

    count = 0
    later = None

    def writes(self, fields, text):
        self.count += 1
        if 13 <= self.count <= 30:
            self.later = (self.now_us + 60_000, fields, text)
        else:
            self.puts(fields, text)

    def idle(self):
        if self.later is not None and self.now_us >= self.later[0]:
            self.puts(*self.later[1:])
            self.later = None


def test_vision_service_that_is_delayed_for_a_while_states_a_true_computing_time():
    result = result_of(next(case for case in VIRTUAL if case.id == "V-CAUS-22"), Loaded)
    assert (result.outcome, result.reason) == (Outcome.PASSED, "")


class StrictClock(VirtualVision):
    """Rejects a frame that runs over 500 ms ahead of what the fastest frame or status of its session allows (2.6)."""

    def __init__(self, network, robot="r1"):
        super().__init__(network, robot)
        self.behind_us = {}
        self.link.subscribe(STATUS, lambda message: self.is_possible(decode(Stamp, message.header)))

    def is_possible(self, stamp):
        behind_us = self.now_us - stamp.t_us
        least_us = self.behind_us.get(stamp.session, behind_us)
        possible = behind_us >= least_us - 500_000
        if possible:
            self.behind_us[stamp.session] = min(least_us, behind_us)
        return possible

    def _frame(self, message, started_ns):
        if self.is_possible(decode(FrameHeader, message.header)):
            super()._frame(message, started_ns)


class LearnsFirst(VirtualVision):
    """Acknowledges the first frames of each session: it has not yet taken in the camera model (10.1)."""

    session, left = "", 0

    def _publish(self, header, answer, compute_us):
        if header.session != self.session:
            self.session, self.left = header.session, 3
        self.left = max(0, self.left - 1)
        super()._publish(header, PipelineAnswer(None, Observation("learns")) if self.left else answer, compute_us)


class NamesNoDetector(vision_broken_flow.Reporting):
    """Its reports have only the fields without a default, and the target (18.4)."""

    def reports(self, fields):
        return {name: fields[name] for name in ("mission", "phase", "target") if name in fields}


@pytest.mark.parametrize(("first", "step", "outcome"), [
    (2**32 - 20 * 2**20, 2**20, Outcome.PASSED), (1, 2**20 + 1, Outcome.FAILED), (2**32 + 1, 1, Outcome.FAILED)])
def test_vision_service_counts_its_twists_as_a_robot_accepts_them(first, step, outcome):
    def writes(self, fields, text):
        self.puts(fields | {"seq": first + step * self.answered}, text)

    counting = type("Counting", (BrokenVision,), {"writes": writes})
    result = result_of(next(case for case in VIRTUAL if case.id == "V-SEQ-07"), counting)
    assert result.outcome is outcome, result.reason


@pytest.mark.parametrize(("name", "change"), [
    ("V-FRAM-05", {"source": "teleop"}), ("V-HEAD-11", {"mission": {"digest": "00000000", "id": 1}}),
    ("V-HEAD-03", {"v": 2}), ("V-HEAD-04", {"session": "ABCDEF01"}),
    ("V-HEAD-05", {"seq": "7"}), ("V-HEAD-06", {"source": None}), ("V-HEAD-07", {"echo": {}}),
    ("V-HEAD-08", {"compute_us": -1}), ("V-HEAD-10", {"sure": float("nan")}), ("V-CAUS-12", {"compute_us": 10**7}),
    ("V-SEQ-01", {"session": "0badf00d"}), ("V-CAUS-01", {"echo.channel": "status"}),
    ("V-CAUS-02", {"echo.session": "0badf00d"}), ("V-CAUS-03", {"echo.seq": 0}), ("V-CAUS-04", {"echo.t_us": 0})])
def test_vision_service_whose_acks_alone_are_wrong_fails(name, change):
    def writes(self, fields, text):
        if text is None:
            echo = fields["echo"] | {key[5:]: value for key, value in change.items() if key.startswith("echo.")}
            fields = fields | {"echo": echo} | {key: value for key, value in change.items() if "." not in key}
        self.puts(fields, text)

    broken = type("Acks", (BrokenVision,), {"writes": writes})
    result = result_of(next(case for case in VIRTUAL if case.id == name), broken)
    assert result.outcome is Outcome.FAILED, result.reason


@pytest.mark.parametrize("nth", [10, 20, 45])
def test_vision_service_that_leaves_out_each_nth_frame_fails(nth):
    class LeavesOut(BrokenVision):
        count = 0

        def hears(self, header, jpeg):
            self.count += 1
            return None if self.count % nth == 0 else (header, jpeg)

    result = result_of(next(case for case in VIRTUAL if case.id == "V-FLOW-05"), LeavesOut)
    assert (result.outcome, "got no answer" in result.reason) == (Outcome.FAILED, True), result.reason


@pytest.mark.parametrize("name", BY_BOXES)
def test_vision_service_that_steers_by_boxes_of_another_peer_passes(name):
    result = result_of(next(case for case in VIRTUAL if case.id == name), vision_broken_steering.Boxes)
    assert (result.outcome, result.reason) == (Outcome.PASSED, "")


def test_two_vision_services_at_one_address_are_reported():
    network = MemoryNetwork()
    bench = VirtualBench(network, [VirtualVision(network), VirtualVision(network)], TO_ROBOT, access=KEYS)
    with pytest.raises(LinkError, match=r"answers of two sessions, \w{8} and \w{8}, come in turn; end the second"):
        is_there(bench)
    result = run_case(next(case for case in VIRTUAL if case.id == "V-FRAM-01"), bench, prepare)
    assert (result.outcome, "end the second vision service" in result.reason) == (Outcome.FAILED, True), result.reason


def test_one_vision_service_that_starts_again_is_not_two():
    bench = virtual_bench()
    assert is_there(bench)
    robot = RobotPlayed(bench)
    robot.film("left", 3)
    bench._peers[0].sender.session = "0badf00d"
    robot.film("left", 3)
    assert len({one.fields["session"] for one in robot.answers()}) == 2


def test_vision_service_that_repeats_a_twist_with_its_seq_while_frames_are_lost_fails():
    class Copies(BrokenVision):
        last = 0

        def decides(self, header, answer):
            self.lost, self.last = header.seq - self.last == 2, header.seq
            return answer

        def writes(self, fields, text):
            for _ in range(1 + self.lost):
                self.puts(fields, text)

    result = result_of(next(case for case in VIRTUAL if case.id == "V-SEQ-02"), Copies)
    assert (result.outcome, "twists came as" in result.reason) == (Outcome.FAILED, True), result.reason


class NotFinite(BrokenVision):
    """Answers an image with a number that is not finite where the odometry or the lens is at its bounds."""

    far = False

    def hears(self, header, jpeg):
        self.far = b"1000000.0" in header or (self._camera is not None and abs(self._camera.cx_px) > 1e5)
        return header, jpeg

    def writes(self, fields, text):
        self.puts(fields, b"0.1000|nan" if self.far and text is not None else text)


@pytest.mark.parametrize("name", ["V-HOST-33", "V-HOST-51"])
def test_vision_service_without_finite_answers_to_absurd_numbers_fails(name):
    result = result_of(next(case for case in VIRTUAL if case.id == name), NotFinite)
    assert (result.outcome, "not finite" in result.reason) == (Outcome.FAILED, True), result.reason


@pytest.mark.parametrize(("name", "vision"), [
    ("V-FRAM-19", StrictClock), ("V-SEQ-05", LearnsFirst), ("V-REP-03", NamesNoDetector)])
def test_case_demands_no_more_than_the_specification(name, vision):
    result = result_of(next(case for case in VIRTUAL if case.id == name), vision)
    assert (result.outcome, result.reason) == (Outcome.PASSED, "")


class SteersLater(VirtualVision):
    """Acknowledges each frame at once, and cites it again when it has looked at it (7.1); then it takes the newest."""

    LOOK_US = 0
    newest = looked = None

    def tick(self, now_us):
        self.now_us = now_us
        if self.looked is not None and now_us >= self.looked[0]:
            super()._publish(*self.looked[1:])
            self.looked = None
        super().tick(now_us)
        if self.looked is None and self.newest is not None:
            self.looked, self.newest = (now_us + self.LOOK_US, *self.newest), None

    def _publish(self, header, answer, compute_us):
        super()._publish(header, PipelineAnswer(None, Observation("takes it up")), compute_us)
        if answer.twist is not None:
            self.newest = (header, answer, compute_us)


LATER = [case for case in VIRTUAL
         if case.id in ("V-FRAM-02", "V-FRAM-14", "V-GRAM-01", "V-CAUS-09", "V-STAT-01", "V-STEER-01", "V-HOST-33",
                        "V-LIM-41")]


@pytest.mark.parametrize("look_us", [60_000, 150_000])
@pytest.mark.parametrize("cases", [LATER, pytest.param(MUST, marks=pytest.mark.slow)], ids=["some", "all"])
def test_vision_service_that_steers_after_its_acknowledgement_passes(cases, look_us):
    later = type("Later", (SteersLater,), {"LOOK_US": look_us})
    results = [result_of(case, later) for case in cases]
    left = {one.case.id: one.outcome for one in results if one.outcome is not Outcome.PASSED}
    # In a minute its chain of proofs does not end, and it has its own detector.
    assert left == dict.fromkeys(("V-PROOF-02", *BY_BOXES) if cases is MUST else (), Outcome.SKIPPED)


class NeverDrives(VirtualVision):
    """Only acknowledges."""

    def _publish(self, header, answer, compute_us):
        super()._publish(header, PipelineAnswer(None, Observation("watches")), compute_us)


def test_vision_service_that_never_drives_does_not_conform():
    cases = [case for case in VIRTUAL if case.id in ("V-FRAM-01", "V-CAUS-08", "V-LIM-14")]
    results = [result_of(case, NeverDrives) for case in cases]
    assert [one.outcome for one in results] == [Outcome.PASSED, Outcome.SKIPPED, Outcome.SKIPPED]
    assert not passed(results)
    assert passed(results[:1])


def test_vision_service_without_proofs_fails_no_case_on_a_link_without_keys():
    for case in (case for case in VIRTUAL if case.id.startswith("V-PROOF")):
        bench = virtual_bench(BROKEN["V-PROOF-03"][1])
        bench.access = Access()
        assert run_case(case, bench, prepare).outcome is Outcome.SKIPPED


HOSTILE = [case for case in VIRTUAL if case.group == "hostile input"]


def test_second_copy_of_an_answer_answers_no_invalid_frame():
    results = [result_of(case, SendsTwice) for case in HOSTILE[::2]]
    assert [(one.case.id, one.reason) for one in results if one.outcome is not Outcome.PASSED] == []


def test_there_are_enough_cases_of_both_levels():
    assert len(VIRTUAL) >= 60
    assert {case.level for case in VIRTUAL} == set(Level)


def test_vision_service_that_swaps_the_axes_fails_must_cases():
    results = [result_of(case, vision_broken_steering.SwappedAxes) for case in VIRTUAL if case.group == "steering"]
    failed = {one.case.id: one.case.level for one in results if one.outcome is Outcome.FAILED}
    assert {name for name, level in failed.items() if level is Level.MUST} >= {
        "V-STEER-01", "V-STEER-03", "V-STEER-09"}  # fmt: skip
    assert not passed(results)


def test_vision_service_that_follows_no_yellow_ball_fails_no_must_case():
    results = [result_of(case, BROKEN["V-STEER-10"][1]) for case in VIRTUAL if case.group == "steering"]
    assert {one.case.id for one in results if one.outcome is Outcome.SKIPPED} == {
        "V-STEER-01", "V-STEER-02", "V-STEER-03", "V-STEER-09", "V-STEER-12", *BY_BOXES}
    assert [one.case.id for one in results if one.outcome is Outcome.FAILED] == ["V-STEER-10"]
    assert passed(results)


@pytest.mark.parametrize("case", [case for case in VIRTUAL if "V-FRAM-11" <= case.id <= "V-FRAM-18"],
                         ids=lambda case: case.id)
def test_headers_that_must_be_read_have_the_block_of_every_message(case):
    bench, blocks = virtual_bench(), []
    send = bench.send

    def watched(channel, header, payload, source):
        if channel is FRAME:
            blocks.append(pack(channel, source, "robot", header, b"")[2:])
        send(channel, header, payload, source)

    bench.send = watched
    assert run_case(case, bench, prepare).outcome is Outcome.PASSED
    assert {block[:20] for block in blocks} == {b'{"channel":"frame","'}


def test_every_clause_is_in_the_specification_and_has_a_case_or_a_reason():
    cited, known = {case.clause for case in (*ROBOT_CASES, *CASES, *CODEC_CASES)}, clauses()
    assert cited <= set(known)
    divided = {clause.split(".")[0] for clause in known if clause.split(".")[1][:1].isdigit()}
    to_be_tested = {one for one in known if one.split(".")[1][:1].isdigit() or one.split(".")[0] not in divided}
    assert to_be_tested - cited == set(UNTESTED)
