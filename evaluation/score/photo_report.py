"""Scores detectors on photographs: with a ball of each kind, then without one. Shell (runs detectors).

`photo_balls.py` renders the balls. Training shares no code with it.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
import simplejpeg

from sightline.evaluation.photographs import Photograph
from sightline.evaluation.score.ball_textures import KINDS
from sightline.evaluation.score.detector_report import Subject, answer_of, detections
from sightline.evaluation.score.detectors import is_hit
from sightline.evaluation.score.photo_balls import photo_with_ball, photo_without_ball
from sightline.sim.scenes.model import HEIGHT_PX, WIDTH_PX, Column, LabelledBox
from sightline.sim.scenes.plan import with_defects
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import Detection, DetectionResult

QUALITY: Final = 85
SMALL_PX: Final = 12.0
"""Balls of a smaller radius have a separate column."""
COLORS: Final = {
    "yellow": (38, 66, 0.5), "tennis": (50, 85, 0.35), "orange": (10, 36, 0.5), "blue": (195, 250, 0.4),
    "green": (85, 165, 0.35), "red": (340, 15, 0.5),
}
"""Hue limits, degrees, and smallest saturation, as a user would set them for a ball of that kind."""
_OFF_PX: Final = 20.0
_OF_EMPTY: Final = 500_000
_SEEDS: Final = 1_000_003
"""Distance between the first images of two seeds."""

Outcome = Literal["hit", "wrong", "missed"]


@dataclass(frozen=True, slots=True)
class PhotoPicture:
    """One JPEG and its ball."""

    number: int
    kind: str
    jpeg: bytes
    ball: LabelledBox | None
    radius_px: float


@dataclass(slots=True)
class BallTally:
    """Number of balls, by outcome: found, wrong object, missed."""

    balls: int = 0
    hit: int = 0
    wrong: int = 0
    missed: int = 0

    def add(self, outcome: Outcome) -> None:
        """Count one image."""
        self.balls += 1
        setattr(self, outcome, getattr(self, outcome) + 1)


@dataclass(slots=True)
class PhotoFigures:
    """The outcomes of one detector."""

    kinds: dict[str, BallTally]
    small: BallTally
    large: BallTally
    """Balls of a radius of `SMALL_PX` or more."""
    empty: int = 0
    false_alarms: int = 0
    """Photographs without a ball, and those of them with a detection."""
    unanswered: int = 0
    """Images without an answer, which count as missed."""
    why: str = ""
    """Cause of the first missing answer."""

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the share of false alarms, low and high, 0..1."""
        return wilson(self.false_alarms, self.empty)


@dataclass(frozen=True, slots=True)
class PhotoReport:
    """Figures by detector."""

    photographs: int
    each: int
    """Images of each kind."""
    seed: int
    tracked: bool
    """True if each detector received the place where a track would expect the ball."""
    figures: dict[str, PhotoFigures]
    column: str = ""
    """Name of the column whose camera took the images, or empty."""

    def to_dict(self) -> dict[str, Any]:
        """Return the object for `--json`."""
        return {**asdict(self), "false_alarm_interval": {name: one.interval for name, one in self.figures.items()}}


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson, Probable Inference, 1927)."""
    if not total:
        return 0.0, 1.0
    z, share = 1.96, count / total
    middle = share + z * z / (2 * total)
    half = z * math.sqrt(share * (1 - share) / total + z * z / (4 * total * total))
    return max(0.0, (middle - half) / (1 + z * z / total)), min(1.0, (middle + half) / (1 + z * z / total))


def photo_pictures(photographs: Sequence[Photograph], each: int, seed: int,
                   kinds: Sequence[str] = KINDS, column: Column | None = None) -> Iterator[PhotoPicture]:
    """Render `each` images of every kind, over the photographs in turn, then each photograph without a ball.

    All are taken with the camera of `column`, if there is one.
    """
    first = seed * _SEEDS
    for number in range(len(KINDS) * each):
        rgb, kind = photographs[number % len(photographs)].rgb, KINDS[number // each]
        if kind not in kinds:
            continue
        drawn = photo_with_ball(rgb, kind, first + number)
        yield PhotoPicture(number, kind, _jpeg(drawn.rgb, number, column), LabelledBox("ball", drawn.box, drawn.seen),
                           drawn.radius_px)
    for place, one in enumerate(photographs):
        number = _OF_EMPTY + place
        yield PhotoPicture(number, "", _jpeg(photo_without_ball(one.rgb, first + number), number, column), None, 0.0)


def _jpeg(rgb: Any, number: int, column: Column | None) -> bytes:
    if column is not None:
        return with_defects(rgb, column, np.random.default_rng([number, 23]))
    return bytes(simplejpeg.encode_jpeg(rgb, QUALITY, "RGB", "420"))


def score_photos(tested: Sequence[Subject], photographs: Sequence[Photograph], each: int, seed: int, *, looks: int = 1,
                 tracked: bool = False, kinds: Sequence[str] = KINDS, column: Column | None = None,
                 advance: Callable[[], None] = lambda: None) -> PhotoReport:
    """Score every image with every detector, `looks` times in a row; `tracked`: as if a track expected the ball."""
    decoder = Decoder(WIDTH_PX, HEIGHT_PX, WIDTH_PX * HEIGHT_PX)
    found = {one.name: PhotoFigures({kind: BallTally() for kind in kinds}, BallTally(), BallTally()) for one in tested}
    for picture in photo_pictures(photographs, each, seed, kinds, column):
        for one in tested:
            answer = answer_of(one, picture.number, picture.jpeg, decoder, looks,
                               expected_px=_expected(picture) if tracked else None)
            _count(found[one.name], picture, best_ball(answer, one.balls))
            if isinstance(answer, str):
                found[one.name].unanswered += 1
                found[one.name].why = found[one.name].why or answer
        advance()
    return PhotoReport(len(photographs), each, seed, tracked, found, column.name if column else "")


def _expected(picture: PhotoPicture) -> tuple[float, float]:
    """Return the ball's place with an error of up to `_OFF_PX`; a random place in an image without a ball."""
    draw = np.random.default_rng([picture.number, 19])
    if picture.ball is None:
        return draw.uniform(0, WIDTH_PX), draw.uniform(0, HEIGHT_PX)
    x1, y1, x2, y2 = picture.ball.box
    return (x1 + x2) / 2 + draw.uniform(-_OFF_PX, _OFF_PX), (y1 + y2) / 2 + draw.uniform(-_OFF_PX, _OFF_PX)


def best_ball(answer: DetectionResult | str, balls: Sequence[str]) -> Detection | None:
    """Return the first detection of a ball: detectors give the best first. No answer shows none."""
    found = detections(answer if isinstance(answer, DetectionResult) else None)
    return next((one for one in found if one.label in balls), None)


def _count(figures: PhotoFigures, picture: PhotoPicture, best: Detection | None) -> None:
    if picture.ball is None:
        figures.empty += 1
        figures.false_alarms += best is not None
        return
    outcome: Outcome = "missed" if best is None else "hit" if is_hit(best, picture.ball) else "wrong"
    figures.kinds[picture.kind].add(outcome)
    (figures.small if picture.radius_px < SMALL_PX else figures.large).add(outcome)


# --- the table, as text ----------------------------------------------------------------------------------------------


def photo_lines(report: PhotoReport) -> list[str]:
    """Format the table for a terminal, or indented for a page."""
    rows: list[tuple[str, ...]] = [("balls", "detector", "pictures", "hits", "wrong", "missed")]
    for kind in (*KINDS, "small", "large"):
        for name, figures in report.figures.items():
            tally = figures.kinds.get(kind) or getattr(figures, kind)
            rows.append((_NAMES.get(kind, kind), name, str(tally.balls), *(
                f"{100 * count / max(1, tally.balls):.1f} %" for count in (tally.hit, tally.wrong, tally.missed))))
    return [*_aligned(rows), *(_empty_line(name, figures) for name, figures in report.figures.items()),
            *(f"{name}: no answer to {one.unanswered} pictures, which count as missed: {one.why}"
              for name, one in report.figures.items() if one.unanswered),
            f"{report.photographs} photographs, {report.each} pictures of each kind, seed {report.seed}"
            + (f", column {report.column}" if report.column else "")
            + (", each ball expected where it is" if report.tracked else "")]


def color_setting(kind: str) -> str:
    """Write the color of a kind as a setting of the vision service."""
    low, high, saturation = COLORS[kind]
    return f"hsv.ranges=[{{hue_low_deg={low}, hue_high_deg={high}, saturation_low={saturation}}}]"


def colored_lines(reports: Mapping[str, PhotoReport]) -> list[str]:
    """Return the same lines for one report per kind, of detectors that received its color."""
    rows: list[tuple[str, ...]] = [("balls", "detector", "pictures", "hits", "wrong", "missed", "false alarms")]
    for kind, report in reports.items():
        for name, one in report.figures.items():
            tally = one.kinds[kind]
            rows.append((kind, name, str(tally.balls), *(f"{100 * count / max(1, tally.balls):.1f} %" for count in (
                tally.hit, tally.wrong, tally.missed)), f"{one.false_alarms} of {one.empty}"))
    return _aligned(rows)


def _aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Return one line for each row, with aligned columns."""
    widths = [max(len(row[place]) for row in rows) for place in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


_NAMES: Final = {"small": f"below {SMALL_PX:.0f} px radius", "large": f"from {SMALL_PX:.0f} px radius"}


def _empty_line(name: str, one: PhotoFigures) -> str:
    low, high = one.interval
    return (f"{name}: a ball in {one.false_alarms} of {one.empty} photographs without one, "
            f"{100 * one.false_alarms / max(1, one.empty):.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %)")
