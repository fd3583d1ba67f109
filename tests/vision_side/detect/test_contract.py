"""The contract kit: our own detectors keep every promise, and each broken one is found out by the promise it breaks."""

import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from random import Random

import pytest

from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import MAX_DETECTED_BOXES
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect import contract
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.contract import LOAD_S, MOST_S, check_detector
from sightline.vision_side.detect.filters import ColorFilter, LabelFilter, TrackIds
from sightline.vision_side.detect.port import NO_DEADLINE, Circle, DetectFrame, Detection, DetectionResult, corners
from sightline.vision_side.detect.registry import build_detector
from sightline.vision_side.detect.remote.fallback import Fallback
from sightline.vision_side.detect.shadow import ShadowDetector
from tests.contracts.detectors import assert_kept
from tests.fixtures.links import until

CONFIG = VisionConfig()


def hsv() -> Hsv:
    return Hsv(Hsv.Config())


@pytest.mark.parametrize("name", ["hsv", "adaptive"])
def test_built_in_detectors_keep_the_contract(name: str) -> None:
    assert_kept(lambda: build_detector(name, {}, CONFIG))


@pytest.mark.parametrize(
    "around",
    [TrackIds, lambda one: ColorFilter(one, CONFIG.hsv.ranges), lambda one: LabelFilter(one, ("target",)),
     lambda one: ShadowDetector(one, hsv(), "hsv", 10**7), lambda one: Fallback(one, hsv())],
    ids=["tracked", "colour", "label", "shadow", "fallback"],
)
def test_wrapped_detectors_keep_the_contract(around) -> None:
    assert_kept(lambda: around(hsv()), seed=11)


class Broken:
    """The colour detector with one fault."""

    def __init__(self) -> None:
        self.inner = hsv()
        self.calls = 0

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        self.calls += 1
        return self.inner.detect(frames, deadline_us)


class Backwards(Broken):
    def detect(self, frames, deadline_us):
        return super().detect(frames, deadline_us)[::-1]


class Short(Broken):
    def detect(self, frames, deadline_us):
        return super().detect(frames, deadline_us)[:1]


class Tired(Broken):
    def detect(self, frames, deadline_us):
        found = super().detect(frames, deadline_us)
        return [None] * len(found) if self.calls % 5 == 0 else found


class Beyond(Broken):
    def detect(self, frames, deadline_us):
        wild = Detection(-5.0, 0.0, 5000.0, 10.0, 0.5, "target")
        return [one and replace(one, detections=(wild,)) for one in super().detect(frames, deadline_us)]


class Sure(Broken):
    def detect(self, frames, deadline_us):
        wild = Detection(1.0, 1.0, 9.0, 10.0, 1.5, "target")
        return [one and replace(one, detections=(wild,)) for one in super().detect(frames, deadline_us)]


class Flat(Broken):
    def detect(self, frames, deadline_us):
        flat = Detection(1.0, 1.0, 9.0, 10.0, 0.5, "target", Circle(5.0, 5.0, 0.0))
        return [one and replace(one, detections=(flat,)) for one in super().detect(frames, deadline_us)]


class Normalized(Broken):
    def detect(self, frames, deadline_us):
        small = tuple(Detection(share / 2, 0.2, share, 0.9, 0.5, "target") for share in (0.3, 1.9))
        return [one and replace(one, detections=small) for one in super().detect(frames, deadline_us)]


class Numbered(Broken):
    def detect(self, frames, deadline_us):
        odd = Detection(1.0, 1.0, 9.0, 10.0, 0.5, "target", track_id=-1)
        return [one and replace(one, detections=(odd,)) for one in super().detect(frames, deadline_us)]


class Crowded(Broken):
    def detect(self, frames, deadline_us):
        many = (Detection(1.0, 1.0, 9.0, 10.0, 0.5, "target"),) * (MAX_DETECTED_BOXES + 1)
        return [one and replace(one, detections=many) for one in super().detect(frames, deadline_us)]


class Raising(Broken):
    def detect(self, frames, deadline_us):
        for one in frames:
            one.picture()
        return super().detect(frames, deadline_us)


class Inventing(Broken):
    """Returns "saw nothing" for bytes that are not an image."""

    def detect(self, frames, deadline_us):
        good = super().detect(frames, deadline_us)
        return [one or self.empty(frame) for frame, one in zip(frames, good, strict=True)]

    @staticmethod
    def empty(frame):
        return DetectionResult(frame.robot, frame.header.session, frame.header.seq, frame.header.t_us, frame.width_px,
                               frame.height_px, (), "broken", "", "cpu")


class Slow(Broken):
    def detect(self, frames, deadline_us):
        if deadline_us != NO_DEADLINE:
            time.sleep(0.3)
        return super().detect(frames, deadline_us)


class Moody(Broken):
    counter = 0

    def __init__(self) -> None:
        super().__init__()
        Moody.counter += 1
        self.mood = Moody.counter % 2

    def detect(self, frames, deadline_us):
        box = Detection(10.0 * self.mood, 1.0, 10.0 * self.mood + 9.0, 10.0, 0.9, "target")
        return [one and replace(one, detections=(box,)) for one in super().detect(frames, deadline_us)]


class Mixing(Broken):
    """Remembers what any robot saw."""

    def detect(self, frames, deadline_us):
        results = []
        for one in super().detect(frames, deadline_us):
            x = float(min(200, self.calls + 40 * len(results)))
            results.append(one and replace(one, detections=(Detection(x, 1.0, x + 9.0, 10.0, 0.9, "target"),)))
        return results


class Nameless(Broken):
    def detect(self, frames, deadline_us):
        return [one and replace(one, device="") for one in super().detect(frames, deadline_us)]


class Labelled(Broken):
    labels = "ball"


class Numbers(Broken):
    labels = 5


class Halved(Broken):
    def detect(self, frames, deadline_us):
        return [one and replace(one, compute_us=12.5) for one in super().detect(frames, deadline_us)]


@pytest.mark.parametrize(
    ("broken", "promise"),
    [(Backwards, "order"), (Short, "order"), (Tired, "answering"), (Beyond, "bounds"), (Sure, "bounds"),
     (Flat, "bounds"), (Normalized, "bounds"), (Numbered, "bounds"), (Crowded, "bounds"),
     (Raising, "silence"), (Inventing, "silence"), (Slow, "deadline"), (Moody, "the_same"), (Mixing, "robots_apart"),
     (Nameless, "its_name"), (Labelled, "its_name"), (Numbers, "its_name"), (Halved, "its_name")],
)
def test_broken_detector_fails_the_promise_that_it_breaks(broken: type[Broken], promise: str) -> None:
    assert promise in {one.name for one in check_detector(broken, 3) if one.wrong}


def moved(change: Callable[[Detection, DetectionResult], tuple[float, ...]]) -> type[Broken]:
    """Return the color detector whose boxes have the corners of `change`."""

    class Moved(Broken):
        def detect(self, frames, deadline_us):
            return [one and replace(one, detections=tuple(self.box(found, one) for found in one.detections))
                    for one in super().detect(frames, deadline_us)]

        @staticmethod
        def box(found: Detection, result: DetectionResult) -> Detection:
            return Detection(*change(found, result), found.score, found.label)

    return Moved


ELSEWHERE = Detection(1.0, 1.0, 9.0, 10.0, 0.9, "target")


def promises_broken(make: type[Broken], monkeypatch: pytest.MonkeyPatch) -> set[str]:
    monkeypatch.setattr(contract, "_CHECKS", (contract._keeps_places,))
    return {one.name for one in check_detector(make, 3) if one.wrong}


@pytest.mark.parametrize(
    "change",
    [lambda one, _: (one.y1_px, one.x1_px, one.y2_px, one.x2_px),
     lambda one, of: (of.width_px - one.x2_px, one.y1_px, of.width_px - one.x1_px, one.y2_px),
     lambda one, of: (one.x1_px, of.height_px - one.y2_px, one.x2_px, of.height_px - one.y1_px),
     lambda one, of: tuple(side / (1 + (of.width_px == 640)) for side in corners(one)),
     lambda one, of: tuple(side * of.width_px / 640 for side in corners(one))],
    ids=["y before x", "mirrored", "from the bottom", "pixels of the half scale", "pixels of another input"],
)
def test_boxes_beside_their_object_break_the_promise(change, monkeypatch) -> None:
    assert promises_broken(moved(change), monkeypatch) == {"places"}


@pytest.mark.parametrize(
    "found",
    [lambda one, _seen: one, lambda one, seen: (*one, ELSEWHERE)[: 2 * (seen % 3)],
     lambda _one, seen: (ELSEWHERE,) * (seen == 5), lambda _one, _seen: (ELSEWHERE,), lambda _one, _seen: ()],
    ids=["all", "other things, too", "once another thing", "always another thing", "nothing"],
)
def test_detector_of_other_objects_keeps_the_promise_of_places(found, monkeypatch) -> None:
    class Other(Broken):
        def detect(self, frames, deadline_us):
            return [one and replace(one, detections=found(one.detections, self.calls))
                    for one in super().detect(frames, deadline_us)]

    assert not promises_broken(Other, monkeypatch)


def test_box_on_a_part_of_its_object_keeps_the_promise(monkeypatch) -> None:
    top = moved(lambda one, _: (one.x1_px + 2, max(0.0, one.y1_px - 2), one.x2_px - 2, one.y1_px + 2))
    assert not promises_broken(top, monkeypatch)


@pytest.mark.parametrize("furthest_px", [2.0, 9.0])
def test_small_boxes_that_reach_further_than_two_pixels_are_kept(furthest_px: float) -> None:
    class Small(Broken):
        def detect(self, frames, deadline_us):
            near = (Detection(0.0, 0.0, 0.5, 0.5, 0.5, "target"), Detection(0.5, 0.5, 1.0, furthest_px, 0.5, "target"))
            return [one and replace(one, detections=near) for one in super().detect(frames, deadline_us)]

    assert "bounds" not in {one.name for one in check_detector(Small, 3) if one.wrong}


def test_author_sees_the_line_that_raises(caplog) -> None:
    check_detector(Raising, 3)
    (raised,) = [record.exc_info[2] for record in caplog.records]
    assert "one.picture()" in [frame.line for frame in traceback.extract_tb(raised)]


@pytest.mark.parametrize("place", ["__init__", "detect", "close"])
def test_detector_that_hangs_breaks_the_promise_and_ends_the_check(monkeypatch, place: str) -> None:
    monkeypatch.setattr(contract, "LOAD_S" if place == "__init__" else "MOST_S", 0.05)
    left, began = threading.Event(), []

    def hang(*_given: object) -> None:
        began.append(place)
        left.wait(30)

    (result,) = check_detector(type("Hanging", (Broken,), {place: hang}), 3)
    what = "loading it" if place == "__init__" else "it"
    assert (result.name, result.wrong) == ("order", f"{what} takes more than 0.05 s; the rest was not checked")
    assert until(lambda: began == [place])
    left.set()


@pytest.mark.parametrize("seed", range(5))
def test_time_to_load_is_apart_from_the_time_of_the_promise(monkeypatch, seed: int) -> None:
    """Before, a model that loads for two minutes was one that hangs."""
    random, now_s, used_s = Random(seed), [1e6 * seed], 0.0
    monkeypatch.setattr(contract.time, "monotonic", lambda: now_s[0])

    def load() -> Broken:
        assert loading.is_now and loading.until_s - now_s[0] == pytest.approx(LOAD_S)
        now_s[0] += random.uniform(0, LOAD_S)
        return Broken()

    loading = contract._Loading(load)
    assert loading.is_now and loading.until_s - now_s[0] == pytest.approx(LOAD_S)
    for _ in range(4):
        loading()
        assert not loading.is_now and loading.until_s - now_s[0] == pytest.approx(MOST_S - used_s)
        step_s = random.uniform(0, MOST_S / 4)
        now_s[0] += step_s
        used_s += step_s


@pytest.mark.parametrize("calls", [1, 2, 16])
def test_time_of_detect_counts_also_after_a_second_detector_has_loaded(monkeypatch, calls: int) -> None:
    monkeypatch.setattr(contract, "_CHECKS", (contract._keeps_robots_apart,))
    monkeypatch.setattr(contract, "MOST_S", 0.1)
    left, count = threading.Event(), []

    class Hanging:
        def detect(self, frames, _deadline_us):
            count.append(1)
            if len(count) >= calls:
                left.wait(5)
            return [Inventing.empty(frame) for frame in frames]

    (result,) = check_detector(Hanging, 3)
    left.set()
    assert result.wrong == "it takes more than 0.1 s; the rest was not checked"


@pytest.mark.parametrize("error", [
    ConfigError("no such file"), OSError("no device"), SystemExit("3"), GeneratorExit("odd")])
def test_error_of_building_a_detector_ends_the_check(error: BaseException) -> None:
    def make() -> Broken:
        raise error

    with pytest.raises(type(error), match=str(error)):
        check_detector(make, 3)


@pytest.mark.parametrize(("answers", "failed"), [
    (tuple, {"order": "an empty batch gets (); expected []"}),
    (lambda given: (None,) * len(given), {"order": "an empty batch gets (); expected []",
                                          "answering": "no answer to image 0 of 320x240",
                                          "silence": "no answer to a good frame after a bad one"}),
])  # fmt: skip
def test_results_in_a_tuple_are_reported_and_each_other_promise_is_checked(answers, failed) -> None:
    """Before, a tuple without an answer had answered every image, and bytes that are not an image got an answer."""

    class InTuple(Broken):
        def detect(self, frames, deadline_us):
            return answers(super().detect(frames, deadline_us))

    assert {one.name: one.wrong for one in check_detector(InTuple) if one.wrong} == failed


@pytest.mark.parametrize("counts", [0, 2])
def test_frame_that_gets_no_single_result_is_reported_as_that(counts) -> None:
    """Before, the row about bytes that are not an image named an IndexError, which the check raised itself."""

    class LeavesOut(Broken):
        def detect(self, frames, deadline_us):
            return [one for one in super().detect(frames, deadline_us) for _ in range(1 if one else counts)]

    wrong = {one.name: one.wrong for one in check_detector(LeavesOut) if one.wrong}
    assert wrong == {"silence": f"1 frame gets {counts} results"}
