"""Hits, misses, localization and average precision of a detector. Pure.

The answer to a frame is the best detection with the label of a ball, as the mission `follow` uses it. A detection on
another object is the unsafe failure, and is counted separately.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from sightline.sim.scenes.model import LabelledBox, Scene
from sightline.vision_side.detect.port import Detection, corners, overlap

BALL_LABELS: Final = ("ball", "sports ball", "target")
HIT_OVERLAP: Final = 0.5
"""Intersection over union with the box of the visible part or of the whole ball, whichever is better."""
CENTRED_FROM: Final = 0.98
"""Visible share from which the center of a hit is compared with the ball's."""

Answer = Literal["hit", "wrong object", "nowhere", "none"]


@dataclass(frozen=True, slots=True)
class FrameResult:
    """One frame: ball or not, answer, score, offset, and compute time (None: no answer)."""

    has_ball: bool
    outcome: Answer
    score: float = 0.0
    off_px: float | None = None
    compute_us: int | None = None


def ball_of(scene: Scene) -> LabelledBox | None:
    """Return the ball, if there is one."""
    return next((one for one in scene.truths if one.label == "ball"), None)


def frame_result(
    detections: Sequence[Detection] | None,
    scene: Scene,
    compute_us: int | None = None,
    balls: Sequence[str] = BALL_LABELS,
) -> FrameResult:
    """Score one frame. None is a missing answer and not a hit. `balls` are the labels of a ball."""
    ball = ball_of(scene)
    candidates = [one for one in detections or () if one.label in balls]
    if not candidates:
        return FrameResult(ball is not None, "none", compute_us=compute_us)
    best = candidates[0]  # detectors give the best first, each by its own measure
    if ball is not None and is_hit(best, ball):
        return FrameResult(True, "hit", best.score, _off_px(best, ball), compute_us)
    outcome: Answer = "wrong object" if _is_on_another(best, scene) else "nowhere"
    return FrameResult(ball is not None, outcome, best.score, compute_us=compute_us)


def is_hit(one: Detection, ball: LabelledBox) -> bool:
    """Return True if the detection is that ball."""
    boxes = [ball.box] if ball.whole is None else [ball.box, ball.whole]
    drawn = [corners(one)]
    if one.circle is not None:
        x, y, radius = one.circle.cx_px, one.circle.cy_px, one.circle.radius_px
        drawn.append((x - radius, y - radius, x + radius, y + radius))
    return max(overlap(mine, true) for mine in drawn for true in boxes) >= HIT_OVERLAP


def _off_px(one: Detection, ball: LabelledBox) -> float | None:
    """Return the distance from the ball's center, if all of it is visible."""
    if ball.whole is None or ball.seen < CENTRED_FROM:
        return None
    x, y = (ball.whole[0] + ball.whole[2]) / 2, (ball.whole[1] + ball.whole[3]) / 2
    if one.circle is not None:
        return math.hypot(one.circle.cx_px - x, one.circle.cy_px - y)
    return math.dist(one.center_px, (x, y))


def _is_on_another(one: Detection, scene: Scene) -> bool:
    """Return True if the center of the detection is in the box of another object."""
    x, y = one.center_px
    others = [*scene.others, *(truth.box for truth in scene.truths if truth.label != "ball")]
    return any(box[0] <= x <= box[2] and box[1] <= y <= box[3] for box in others)


@dataclass(frozen=True, slots=True)
class DetectorFigures:
    """Figures of one detector in one column. Shares are 0..1."""

    frames: int
    balls: int
    hits: float
    """Share of the frames with a ball."""
    missed: float
    """Share of the frames with a ball that have no answer."""
    wrong_object: float
    """Share of all frames whose answer is another object."""
    false_alarms: float
    """Share of the frames without a ball that have any answer."""
    centre_p50_px: float | None
    """Of hits on fully visible balls."""
    centre_p95_px: float | None
    compute_p50_us: float | None
    nowhere: float
    """Share of the frames with a ball whose answer is neither on it nor on another object."""


def figures(frames: Sequence[FrameResult]) -> DetectorFigures:
    """Compute the figures of many frames."""
    balls = [one for one in frames if one.has_ball]
    empty = [one for one in frames if not one.has_ball]
    off = [one.off_px for one in balls if one.off_px is not None]
    times = [float(one.compute_us) for one in frames if one.compute_us is not None]
    return DetectorFigures(
        len(frames), len(balls), _share(one.outcome == "hit" for one in balls),
        _share(one.outcome == "none" for one in balls), _share(one.outcome == "wrong object" for one in frames),
        _share(one.outcome != "none" for one in empty), _quantile(off, 0.5), _quantile(off, 0.95),
        _quantile(times, 0.5), _share(one.outcome == "nowhere" for one in balls),
    )


def _share(marks: Iterable[bool]) -> float:
    counted = list(marks)
    return sum(counted) / len(counted) if counted else 0.0


def _quantile(values: Sequence[float], share: float) -> float | None:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


@dataclass
class LabelMatches:
    """One label over many frames: number of objects, and every detection, marked right or wrong."""

    objects: int = 0
    marks: list[tuple[float, bool]] = field(default_factory=list)

    def add(self, label: str, detections: Sequence[Detection], scene: Scene) -> None:
        """Add one frame. The surest detection counts once per object; one on an unclear object does not count."""
        left = [one.box for one in scene.truths if one.label == label]
        self.objects += len(left)
        for one in sorted((one for one in detections if one.label == label), key=lambda one: -one.score):
            own = corners(one)
            best = max(left, key=lambda box: overlap(own, box), default=None)
            if best is not None and overlap(own, best) >= HIT_OVERLAP:
                left.remove(best)
                self.marks.append((one.score, True))
            elif not any(overlap(own, box) > 0 for box in scene.unclear):
                self.marks.append((one.score, False))

    def take(self, more: "LabelMatches") -> None:
        """Add the matches of this label in other frames."""
        self.objects += more.objects
        self.marks += more.marks

    def average_precision(self) -> float | None:
        """Return AP50, the area under the non-increasing precision over recall; None without objects."""
        if not self.objects:
            return None
        right, points = 0, []
        for count, (_, is_right) in enumerate(sorted(self.marks, key=lambda mark: -mark[0]), start=1):
            right += is_right
            points.append((right / self.objects, right / count))
        area, best, last = 0.0, 0.0, points[-1][0] if points else 0.0
        for recall, precision in reversed(points):
            area += best * (last - recall)
            best, last = max(best, precision), recall
        return area + best * last


def precisions(found: Mapping[str, LabelMatches]) -> dict[str, tuple[int, float | None]]:
    """Return objects and AP50 of each label. A detector that finds none of the labels has no figures."""
    if not any(one.marks for one in found.values()):
        return {}
    return {label: (one.objects, one.average_precision()) for label, one in found.items()}
