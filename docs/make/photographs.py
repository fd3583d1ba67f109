"""Write docs/reference/results/photographs.md: detectors on the shipped photographs, with images. Shell.

    python -m docs.make.photographs
"""

import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from sightline.evaluation.photographs import SHIPPED, Photograph, read_photographs
from sightline.evaluation.score.ball_textures import KINDS
from sightline.evaluation.score.detector_report import Subject, answer_of, close_subjects, subjects
from sightline.evaluation.score.photo_report import (
    COLORS,
    PhotoPicture,
    PhotoReport,
    best_ball,
    color_setting,
    colored_lines,
    photo_lines,
    photo_pictures,
    score_photos,
)
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.terminal import progress_bar
from sightline.sim.scenes.model import COLUMNS
from sightline.vision_side.detect.onnx.detector import shipped_digest

PAGE: Final = Path(__file__).parents[1] / "reference" / "results" / "photographs.md"
NAMES: Final = ("onnx", "hsv")
SEED = 1
"""As in the command on the page, where each photograph is shown once with a ball of each kind."""
HARD: Final = "all at once"
_LEAST_EXPECTED: Final = {"white": 85, "basketball": 90, "football": 75}
SHOWN_SEED: Final = 2
_GREEN, _RED = (60, 220, 60), (40, 40, 255)


def write_image(path: Path, subject: Subject, photographs: Sequence[Photograph]) -> None:
    """Write two images of each kind, side by side: the ball's box in green, the detector's answer in red."""
    import cv2
    import numpy as np

    images = [image_of(one, subject) for one in photo_pictures(photographs, 2, SHOWN_SEED) if one.ball is not None]
    rows = [np.hstack(images[first : first + 6]) for first in range(0, len(images), 6)]
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 80])


def image_of(picture: PhotoPicture, subject: Subject) -> Any:
    """Return one image, BGR, with both boxes."""
    import cv2
    import simplejpeg

    from sightline.vision_side.decode import Decoder

    bgr = simplejpeg.decode_jpeg(picture.jpeg, "BGR")
    answer = answer_of(subject, picture.number, picture.jpeg, Decoder(320, 240, 320 * 240), 1)
    found = best_ball(answer, subject.balls)
    boxes = [(picture.ball.box, _GREEN)] if picture.ball else []
    boxes += [((found.x1_px, found.y1_px, found.x2_px, found.y2_px), _RED)] if found else []
    for grown, ((x1, y1, x2, y2), color) in enumerate(reversed(boxes)):
        off = 2 * grown
        cv2.rectangle(bgr, (round(x1) - off, round(y1) - off), (round(x2) + off, round(y2) + off), color, 1)
    return bgr


def bound_lines(
    once: PhotoReport, plain: PhotoReport, tracked: PhotoReport, colored: Mapping[str, PhotoReport]
) -> Iterator[str]:
    """Yield a table of bounds and figures of the detector. A missed bound is bold."""
    name = NAMES[0]

    def least_hits(reports: Mapping[str, PhotoReport]) -> float:
        tallies = [report.figures[name].kinds[kind] for kind, report in reports.items()]
        return min(_percent(one.hit, one.balls) for one in tallies)

    without, two = plain.figures[name], tracked.figures[name]
    rows: list[tuple[str, str, float, float]] = [
        ("the worst kind with a color of its own, one look", ">=", 85, least_hits(dict.fromkeys(COLORS, once))),
        ("the same, without a track", ">=", 85, least_hits(dict.fromkeys(COLORS, plain))),
        ("the same, expected", ">=", 92, least_hits(dict.fromkeys(COLORS, tracked))),
        ("the same, with its color set", ">=", 90, least_hits(colored)),
        *((f"{kind}, expected", ">=", least, least_hits({kind: tracked})) for kind, least in _LEAST_EXPECTED.items()),
        ("below 12 px radius, expected", ">=", 80, _percent(two.small.hit, two.small.balls)),
        ("from 12 px radius, expected", ">=", 96, _percent(two.large.hit, two.large.balls)),
        ("another place marked, the worst kind, expected", "<=", 3,
         max(_percent(one.wrong, one.balls) for one in two.kinds.values())),
        ("photographs without a ball, with a false one", "<=", 3, _percent(without.false_alarms, without.empty)),
        ("the upper end of its 95 % interval", "<=", 5, 100 * without.interval[1]),
    ]  # fmt: skip
    yield f"| figure | bound | {name} |"
    yield "|---|---|---|"
    for what, sign, bound, value in rows:
        is_reached = value >= bound if sign == ">=" else value <= bound
        yield f"| {what} | {sign} {bound:g} % | {f'{value:.1f}' if is_reached else f'**{value:.1f}**'} |"


def _percent(count: int, total: int) -> float:
    return 100.0 * count / max(1, total)


def page_lines(once: PhotoReport, plain: PhotoReport, tracked: PhotoReport, hard: PhotoReport,
               colored: Mapping[str, PhotoReport]) -> Iterator[str]:
    """Yield the page, block by block."""
    yield "# Photographs\n"
    yield (
        f"Ray-cast balls of {len(KINDS)} kinds in the {plain.photographs} photographs that come with Sightline\n"
        "(`evaluation/score/photographs/SOURCES.md` names their origin), and each photograph without a ball.\nA hit "
        "overlaps the ball by half. [The learned detector](../../explanation/learned-detector.md#in-photographs) "
        "explains it.\n"
    )
    yield (f"Written by `python -m docs.make.photographs` on {platform.machine()} with the model {shipped_digest()}, "
           f"ONNX Runtime {version('onnxruntime')}\nand OpenCV {version('opencv-python-headless')}.\n")
    yield f"![two images of each kind; green: the ball, red: the answer of {NAMES[0]}](photographs/images.jpg)\n"
    yield "## Bounds\n"
    yield (
        "Hits in percent, unless the row names something else; bold: not reached. Expected: with the second look, "
        "where a track\nexpects the ball. Without a track, a thing in doubt gets the second look, except in the first "
        "row.\n"
    )
    yield from bound_lines(once, plain, tracked, colored)
    yield ""
    for title, lines, option in (
        ("Without a track", photo_lines(plain), ""),
        ("Where a track expects the ball", photo_lines(tracked), " --tracked"),
        ("Dim or wrong light, blur and quality 30 at once", photo_lines(hard), f' --column "{HARD}"'),
        ("With the color of the ball set", colored_lines(colored), " --colored"),
    ):
        yield f"## {title}\n"
        yield f"```text\n$ sightline score detectors {' '.join(NAMES)} --photos shipped --frames {plain.each}{option}"
        yield from lines
        yield "```\n"


def _colored(kind: str, photographs: Sequence[Photograph], advance: Callable[[], None]) -> PhotoReport:
    """Score the detectors with the color of a kind set."""
    loaded: Any = load_service("vision", file=None, sets=(color_setting(kind),), options={}, environ={}).config
    asked = subjects(NAMES, loaded)
    try:
        return score_photos(asked, photographs, len(photographs), SEED, kinds=(kind,), advance=advance)
    finally:
        close_subjects(asked)


def _looking_once(photographs: Sequence[Photograph], advance: Callable[[], None]) -> PhotoReport:
    """Score the learned detector without its second look."""
    asked = subjects(NAMES[:1], options={NAMES[0]: {"second_look": False}})
    try:
        return score_photos(asked, photographs, len(photographs), SEED, kinds=COLORS, advance=advance)
    finally:
        close_subjects(asked)


def main() -> int:
    """Score the detectors on the shipped photographs, and write the page."""
    photographs, asked = read_photographs(SHIPPED), subjects(NAMES)
    try:
        shown = len(photographs) * (3 * (len(KINDS) + 1) + 3 * len(COLORS) + 1)
        with progress_bar(shown) as advance:
            plain, tracked, hard = (
                score_photos(asked, photographs, len(photographs), SEED, tracked=told, column=column, advance=advance)
                for told, column in ((False, None), (True, None), (False, COLUMNS[HARD])))
            once = _looking_once(photographs, advance)
            colored = {kind: _colored(kind, photographs, advance) for kind in COLORS}
        folder = PAGE.parent / PAGE.stem
        folder.mkdir(exist_ok=True)
        write_image(folder / "images.jpg", asked[0], photographs)
    finally:
        close_subjects(asked)
    PAGE.write_text("\n".join(page_lines(once, plain, tracked, hard, colored)).rstrip() + "\n", "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
