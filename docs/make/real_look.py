"""Write docs/reference/results/real-look.md: every scenario with the look `real`, and its drawing speed. Shell.

    python -m docs.make.real_look --seeds 301,302,303
    python -m docs.make.real_look --only legs-crowd,three-balls      # these again; other rows keep their last run
"""

import argparse
import os
import platform
import re
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from statistics import median, quantiles
from typing import Final

from sightline.evaluation.checks import number
from sightline.evaluation.scenario_config import robot_of, vision_config
from sightline.evaluation.score.figures import granted, is_within
from sightline.evaluation.score.runs import ScoreCase, ScoredFigure, cases, run_cases
from sightline.operator_side.terminal import progress_bar
from sightline.sim.scenario import Scenario, load_scenario, look_named, scenario_names
from sightline.vision_side.config import DetectorConfig

PAGE: Final = Path(__file__).parents[1] / "reference" / "results" / "real-look.md"
LOOK: Final = "real"
LATENCY_MS, LOSS = 50.0, 0.1
LEARNED, COLOR = "onnx", "hsv"
WIDER: Final = 1.5
"""Factor on the bounds of the plain world, permitted in this look."""
LEAST_PER_S: Final = 30.0
"""Images that must be drawn in a second, 320x240."""
TIMED: Final = ("circle", "walls", "traffic-light", "legs-crowd")
SHOWN: Final = (*TIMED, "legs")
_IMAGES: Final = 300  # drawn for each time; a fast machine needs 3 s
_STEPS: Final = 8  # of the world between two images, about 30 images per second of world time
_SHOWN_SEED: Final = 301
_SHOWN_AFTER_S: Final = 1.0
_TIMES: Final = "## Time to draw"
_WITHIN: Final = f"within x {WIDER:g}"


# --- speed ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DrawTime:
    """Time of one image, with its JPEG, in one scenario."""

    scenario: str
    look: str
    p50_ms: float
    p99_ms: float

    @property
    def per_s(self) -> float:
        """Return the images that the median allows in a second."""
        return 1000 / self.p50_ms


def with_look(name: str, look: str) -> Scenario:
    """Return a scenario with that look."""
    return load_scenario(name).model_copy(update={"look": look_named(look)})


def draw_time(name: str, look: str, images: int = _IMAGES) -> DrawTime:
    """Draw images while the robot drives a curve, when the shutter has the most work."""
    from sightline.sim.world.world import World

    scenario, times_ms = with_look(name, look), []
    with World(scenario, robot_of(scenario, "raspberry"), _SHOWN_SEED) as world:
        world.set_wheels(4.0, 9.0)
        for _ in range(images):
            for _ in range(_STEPS):
                world.step()
            begin_s = time.perf_counter()
            world.render()
            times_ms.append(1000 * (time.perf_counter() - begin_s))
    return DrawTime(name, look, median(times_ms), quantiles(times_ms, n=100)[-1])


def write_image(path: Path) -> None:
    """Write one image of each scenario of `SHOWN`, side by side."""
    import cv2
    import numpy as np
    import simplejpeg

    from sightline.sim.world.world import STEP_US, World

    images = []
    for name in SHOWN:
        scenario = with_look(name, LOOK)
        with World(scenario, robot_of(scenario), _SHOWN_SEED) as world:
            for _ in range(round(_SHOWN_AFTER_S * 1e6 / STEP_US)):
                world.step()
            images.append(simplejpeg.decode_jpeg(world.render(), "BGR"))
    cv2.imwrite(str(path), np.hstack(images), [cv2.IMWRITE_JPEG_QUALITY, 88])


# --- scores -----------------------------------------------------------------------------------------------------------


def wanted_cases(names: Sequence[str], seeds: Sequence[int]) -> list[ScoreCase]:
    """Return the runs with the look of each scenario and with `LOOK`, and those of the learned detector for balls."""
    own = [replace(case, detector=color_detector(case.scenario)) for look in (None, LOOK)
           for case in cases(names, seeds, [LATENCY_MS], [LOSS], None, look=look)]
    balls = [name for name in names if load_scenario(name).target.shape == "ball" and color_detector(name)]
    return own + (cases(balls, seeds, [LATENCY_MS], [LOSS], None, look=LOOK, detector=LEARNED) if balls else [])


def own_detector(name: str) -> str:
    """Return the source of detections in a scenario: detector, simulation or range sensor."""
    scenario = load_scenario(name)
    if scenario.goals_m:
        return "none: range sensor"
    if scenario.labels:
        return "none: labels of the simulation"
    return f"`{color_detector(name) or vision_config(scenario, robot_of(scenario)).detector.kind}`"


def color_detector(name: str) -> str | None:
    """Return the color detector for a scenario without a fixed detector, None for all others."""
    scenario = load_scenario(name)
    leaves_it = vision_config(scenario, robot_of(scenario)).detector.kind == DetectorConfig().kind
    return COLOR if leaves_it and not scenario.labels and not scenario.goals_m else None


def page_lines(
    wanted: Sequence[ScoreCase], scored: Sequence[ScoredFigure], draws: Sequence[DrawTime], command: str,
    older: str = "",
) -> Iterator[str]:
    """Yield the page, block by block. Rows of other scenarios, and times without `draws`, are those of page `older`."""
    seeds = list(dict.fromkeys(case.seed for case in wanted))
    yield "# The look real\n"
    yield (
        f"Every scenario with `look = \"{LOOK}\"`: a room of colors near the target's, an uncalibrated lens, a rolling "
        "shutter, motion\nblur, drift and latency. [Looks](../looks.md) lists its options. What fails here is a "
        "limit of today's detectors, published as it is.\n"
    )
    yield (
        f"In lockstep on {len(seeds)} starts (seeds {', '.join(map(str, seeds))}), +{LATENCY_MS:g} ms latency, "
        f"{LOSS:.0%} loss on each leg. The worst start counts.\n"
        f"Written by `{command}`; `--only NAME` runs a scenario\nagain. One scenario: `sightline score "
        f"--scenario circle --look {LOOK}`.\n"
    )
    yield f"![the camera's images in {', '.join(SHOWN)}](real-look/images.jpg)\n"
    again = {case.scenario for case in wanted}
    rows = [row for row in rows_of(older) if row[0] not in again] + _rows(wanted, scored)
    yield from _summary(rows)
    yield from _table(sorted(rows, key=lambda row: row[0]))
    yield from _draw_lines(draws) if draws else [_TIMES + older.partition(_TIMES)[2].rstrip("\n")]


def rows_of(page: str) -> list[list[str]]:
    """Return the cells of the rows of scenarios."""
    lines = re.findall(r"^\| (\S+ \| (?:`|none:).*) \|$", page, re.MULTILINE)
    return [[cell.strip() for cell in line.split("|")] for line in lines]


def _groups(wanted: Sequence[ScoreCase]) -> list[ScoreCase]:
    """Return one case of each group with `LOOK`."""
    own = (case for case in wanted if case.look == LOOK)
    return [next(members) for _, members in groupby(own, key=lambda case: case.group)]


def _detector(case: ScoreCase) -> str:
    return f"`{case.detector}`" if case.detector else own_detector(case.scenario)


def _summary(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| detector | scenarios | within all bounds | within {WIDER:g} times the bounds |\n|---|---:|---:|---:|"
    for detector in sorted({row[1] for row in rows}):
        results = [row[3] for row in rows if row[1] == detector]
        kept = results.count("ok")
        yield f"| {detector} | {len(results)} | {kept} | {kept + results.count(_WITHIN)} |"
    yield ""


def _rows(wanted: Sequence[ScoreCase], scored: Sequence[ScoredFigure]) -> list[list[str]]:
    return [
        [case.scenario, _detector(case), "" if case.detector == LEARNED else _result(replace(case, look=None), scored),
         _result(case, scored), "; ".join(_broken(one) for one in scored if one.group == case.group and not one.ok)]
        for case in _groups(wanted)
    ]


def _table(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    yield (
        "`own look` is the result of the same starts with the look of the scenario itself: what fails there, too, is "
        "not an effect of the\nlook. A `least_` figure must not fall below its bound, the others must not exceed it.\n"
    )
    yield (f"| scenario | detector | own look | {LOOK} | figures outside their bounds with {LOOK}: worst start, median "
           "(bound) |\n|---|---|---|---|---|")
    yield from (f"| {' | '.join(row)} |" for row in rows)
    yield ""


def _result(case: ScoreCase, scored: Sequence[ScoredFigure]) -> str:
    """Return the result of a group of runs. Without a bound, nothing was evaluated."""
    figures = [one for one in scored if one.group == case.group]
    if not figures:
        return "not evaluated"
    if all(one.ok for one in figures):
        return "ok"
    is_near = all(is_within(one.name, one.worst, granted(one.name, one.bound, WIDER)) for one in figures)
    return _WITHIN if is_near and case.look == LOOK else "**fails**"


def _broken(one: ScoredFigure) -> str:
    worst, middle = ("never" if value is None else number(value) for value in (one.worst, one.median))
    return " ".join(f"{one.name} {worst}, {middle} ({number(one.bound)} {one.unit})".split()).replace(" )", ")")


def _draw_lines(draws: Sequence[DrawTime]) -> Iterator[str]:
    slowest = min((one for one in draws if one.look == LOOK), key=lambda one: one.per_s)
    result = "ok" if slowest.per_s >= LEAST_PER_S else "**too slow**"
    yield f"{_TIMES}\n"
    yield (
        f"Robot `raspberry`, 320x240, driving a curve, {_IMAGES} images each with their JPEG, one process on "
        f"{platform.machine()} with\n{os.cpu_count()} cores. "
        f"The slowest scenario draws {slowest.per_s:.0f} images per second (at least {LEAST_PER_S:g}): {result}.\n"
    )
    yield "| scenario | look | p50 | p99 | images per second |\n|---|---|---:|---:|---:|"
    for one in draws:
        yield f"| {one.scenario} | {one.look} | {one.p50_ms:.1f} ms | {one.p99_ms:.1f} ms | {one.per_s:.0f} |"


def write_page(page: Path, names: Sequence[str], seeds: Sequence[int], jobs: int, *, only: bool = False) -> bool:
    """Measure, run and write `page`. Returns True if images are drawn fast enough, regardless of scores.

    With `only` the page keeps its other rows and its times.
    """
    draws = [] if only else [draw_time(name, look) for name in TIMED for look in (LOOK, "plain")]
    wanted = wanted_cases(names, seeds)
    folder = page.parent / page.stem
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / "images.jpg")
    with progress_bar(len(wanted)) as advance:
        report = run_cases(wanted, jobs, lambda _case: advance())
    command = f"python -m docs.make.real_look --seeds {','.join(map(str, seeds))}"
    older = page.read_text("utf-8") if only else ""
    page.write_text("\n".join(page_lines(wanted, report.scored, draws, command, older)) + "\n", "utf-8")
    return all(one.per_s >= LEAST_PER_S for one in draws)


def main() -> int:
    """Run every scenario with the look real, and write the page."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seeds", default="301,302,303", help="separated by commas")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at once")
    parser.add_argument("--only", default="", help="scenarios, separated by commas")
    given = parser.parse_args()
    seeds, names = [int(seed) for seed in given.seeds.split(",")], given.only.split(",") if given.only else []
    return 0 if write_page(PAGE, names or scenario_names(), seeds, given.jobs, only=bool(names)) else 5


if __name__ == "__main__":
    sys.exit(main())
