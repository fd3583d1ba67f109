"""Write docs/reference/results/behaviors.md: every scenario with its baseline, in figures and pictures. Shell.

    python -m docs.make.behaviors --seeds 201,202,203,204,205,206
    python -m docs.make.behaviors --only three-balls,Light      # these parts again; the others keep their last run
"""

import argparse
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from docs.make.real_look import color_detector
from sightline.evaluation.checks import Check, number
from sightline.evaluation.lockstep import Conditions, run_lockstep
from sightline.evaluation.plots import ROBOT_COLOR, plot_run
from sightline.evaluation.processes import worker_pool
from sightline.evaluation.scenario_config import robot_of
from sightline.evaluation.score.figures import (
    EXACT,
    HARDEST_MPS2,
    REACHED_WITHIN_M,
    READ_WITHIN_M,
    SETTLED_S,
    Score,
    checks_of,
    median_and_worst,
    score,
)
from sightline.evaluation.score.runs import ScoreCase, run_of
from sightline.operator_side.terminal import progress_bar
from sightline.sim.scenario import FIGURES, Scenario, Start, load_scenario
from sightline.sim.truth import Truth

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAGE: Final = Path(__file__).parents[1] / "reference" / "results" / "behaviors.md"
LATENCY_MS, LOSS = 50.0, 0.1
LOOKS: Final = ("dim", "bright", "warm", "desaturated", "quality30")
"""Further light conditions in which a traffic light must be read."""


@dataclass(frozen=True, slots=True)
class Row:
    """One behavior: a scenario, and a law in place of its own for a baseline."""

    scenario: str
    baseline: str = ""
    robot: str | None = None
    looks: tuple[str, ...] = ()
    """Further light conditions of its runs."""
    seconds: float | None = None
    """Length of each run; None: the scenario's own."""

    @property
    def law(self) -> str:
        """Return the mission that drives."""
        return self.baseline or load_scenario(self.scenario).mission

    @property
    def title(self) -> str:
        """Return the heading."""
        extra = f", baseline `{self.baseline}`" if self.baseline else ""
        return self.scenario + (f", robot `{self.robot}`" if self.robot else "") + extra

    @property
    def anchor(self) -> str:
        """Return the anchor of that heading."""
        return self.title.replace("`", "").replace(",", "").replace(" ", "-")

    @property
    def default(self) -> "Row":
        """Return the row that a baseline is compared with."""
        return Row(self.scenario, "", self.robot, seconds=self.seconds)

    def cases(self, seeds: Sequence[int], look: str | None = None) -> list[ScoreCase]:
        """Return the runs in one light; None: the scenario's own."""
        mission, detector = self.baseline or None, color_detector(self.scenario)
        return [ScoreCase(self.scenario, LATENCY_MS, LOSS, seed, self.seconds, mission, self.robot, look, detector)
                for seed in seeds]

    def all_cases(self, seeds: Sequence[int]) -> list[ScoreCase]:
        """Return the runs in every light."""
        return [case for look in (None, *self.looks) for case in self.cases(seeds, look)]


ROWS: Final = (
    Row("blue-sphere"), Row("blue-sphere", "band"), Row("blue-sphere-eight"),
    Row("ball"), Row("ball", "pixel-pi"), Row("ball-eight"),
    Row("blocks"), Row("blocks-red"), Row("blocks-yellow"), Row("blocks", "pixel-pi"), Row("blocks-eight"),
    Row("chaser"), Row("chaser", robot="chaser"), Row("chaser", "pixel-p"), Row("chaser-circle"), Row("chaser-eight"),
    Row("legs-slow"), Row("legs"), Row("legs-fast"), Row("legs-crowd"), Row("three-balls"), Row("three-boxes"),
    Row("legs", "legs-baseline"),
    Row("traffic-light", looks=LOOKS), Row("traffic-light-boxes", looks=LOOKS),
    Row("thymio"), Row("thymio-box"), Row("thymio-slalom"), Row("thymio-trap"), Row("thymio-closed"),
    Row("thymio", "goto-baseline"), Row("thymio-trap", "goto-baseline"),
    Row("occluder"),
)  # fmt: skip



@dataclass(frozen=True, slots=True)
class Table:
    """Some figures of scenarios in several looks, with the default detector."""

    title: str
    summary: str
    scenarios: tuple[str, ...]
    looks: tuple[str, ...]
    figures: tuple[str, ...]
    seeds: tuple[int, ...]

    def cases(self, scenario: str, look: str) -> list[ScoreCase]:
        """Return the runs of one line."""
        return [ScoreCase(scenario, LATENCY_MS, LOSS, seed, None, look=look) for seed in self.seeds]

    def lines(self) -> Iterator[tuple[str, str]]:
        """Yield scenario and look of each line."""
        return product(self.scenarios, self.looks)


_CROSSED: Final = ("three-balls", "three-boxes", "legs-crowd")
_IDENTITY: Final = ("wrong_percent", "lost_after_s", "found_again_s")
_IDENTITY_SEEDS: Final = tuple(range(401, 421))
TABLES: Final = (
    Table("Identity", "Others like the target cross before and behind it. The share of the time in which the robot "
          "follows another object,\nthe longest time until it stops to, and the longest time until it follows the "
          "target again that is in view.", _CROSSED, ("plain",), _IDENTITY, _IDENTITY_SEEDS),
    Table("Identity in the real look", "The same with the look `real`.", _CROSSED, ("real",), _IDENTITY,
          _IDENTITY_SEEDS),
    Table("Light", "The ball on a circle under other lamps, in a fifth of the light and with 0.3 of the saturation.",
          ("circle",), ("tungsten", "fluorescent", "dark", "pale"), ("bearing_rms_deg", "lost_percent"),
          (201, 202, 203, 204, 205, 206)),
)  # fmt: skip

CHARACTER: Final = {
    "band": "It drives straight at 0.1 m/s and does not turn before the ball is 30 % of the image width off "
        "center. The ball is faster: soon it looks too small for the band, so the robot stands, and the ball "
        "leaves the image.",
    "pixel-pi": "It does not turn within 20 pixels of the center. So the target stays some degrees to one side and "
        "swings there, more and more as the sum of all corrections grows. The speed 200 / area fits one "
        "distance only.",
    "pixel-p": "It decides five times a second, by pixels: forward until the radius of the ball is 50 pixels, then "
        "not at all. So it holds the wrong distance, by runs and stops. It points well at a ball that rolls "
        "straight ahead.",
    "legs-baseline": "It sums errors without time and clamp, and its field differs to the left and right. The human "
        "swings from edge to edge of the image, and out of it.",
    "goto-baseline": "Its sensors reach 0.2 m. It arrives at up to 0.5 m/s and turns by the clock. With this delay it "
        "is so near when it turns that the range guard lets no corner approach. It never drives back, and cannot "
        "report that the way is closed. Without delay it drives around the cylinder of `thymio`.",
}
"""The character of each legacy controller, and the reason of its failures."""


# Speed of the Thymio on a free path, with the default mission and with the legacy one. Pure.


LAWS: Final = ("goto", "goto-baseline")
GOALS_M: Final = (0.2, 2.0, 10.0)
"""The waypoints of the legacy plots."""
_SLOWEST_MPS: Final = 0.2  # speed that either law reaches on a free path, with time to settle
_SETTLES_S: Final = 8.0
_ACROSS: Final = 5  # samples to either side: the acceleration over 0.2 s, because single physics steps are noisy


@dataclass(frozen=True, slots=True)
class SpeedCase:
    """One drive to run."""

    law: str
    goal_m: float
    seed: int


@dataclass(frozen=True, slots=True)
class SpeedRun:
    """The result of one drive, from the record of the world: one entry of each list per sample."""

    wish: SpeedCase
    times_s: list[float]
    speeds_mps: list[float]
    accelerations_mps2: list[float]
    arrived_s: float | None
    """Time of the first arrival at the waypoint."""
    off_m: float
    """Distance from the waypoint at the end."""

    @property
    def top_mps(self) -> float:
        """Return the highest speed."""
        return max(self.speeds_mps)


def speed_cases(seed: int) -> list[SpeedCase]:
    """Return every law with every waypoint."""
    return [SpeedCase(law, goal_m, seed) for law in LAWS for goal_m in GOALS_M]


def free_way(goal_m: float) -> Scenario:
    """Return the Thymio's scenario without obstacles and with the waypoint straight ahead."""
    thymio = load_scenario("thymio")
    return thymio.model_copy(update={
        "things": (), "goals_m": ((goal_m, 0.0),), "start": Start(at_m=(0.0, 0.0)),
        "target": thymio.target.model_copy(update={"at_m": (goal_m, 0.0)}),
        "seconds": goal_m / _SLOWEST_MPS + _SETTLES_S,
    })


def speed_run(wish: SpeedCase) -> SpeedRun:
    """Run a drive under the conditions of the page."""
    scenario = free_way(wish.goal_m)
    mission = None if wish.law == scenario.mission else wish.law
    run = run_lockstep(scenario, robot_of(scenario), wish.seed, Conditions(LATENCY_MS, LOSS), mission=mission)
    return speeds_of(wish, run.samples)


def speeds_of(wish: SpeedCase, samples: Sequence[Truth]) -> SpeedRun:
    """Return the figures of a drive along x."""
    times_s = [(truth.t_us - samples[0].t_us) / 1e6 for truth in samples]
    speeds_mps = [truth.linear_mps for truth in samples]
    off_m = [abs(complex(truth.x_m - wish.goal_m, truth.y_m)) for truth in samples]
    arrived_s = next((t_s for t_s, off in zip(times_s, off_m, strict=True) if off <= REACHED_WITHIN_M), None)
    return SpeedRun(wish, times_s, speeds_mps, _slopes(times_s, speeds_mps), arrived_s, off_m[-1])


def _slopes(times_s: Sequence[float], values: Sequence[float]) -> list[float]:
    last = len(values) - 1
    ends = [(max(0, at - _ACROSS), min(last, at + _ACROSS)) for at in range(len(values))]
    return [(values[end] - values[begin]) / (times_s[end] - times_s[begin]) for begin, end in ends]


# thymio-speeds.png: speed and acceleration over time, a column per waypoint, both laws. Shell (writes a file).


_COLORS = dict(zip(LAWS, (ROBOT_COLOR, "tab:red"), strict=True))


def plot_speeds(path: Path, runs: Sequence[SpeedRun]) -> None:
    """Draw `runs`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    for column, goal_m in enumerate(GOALS_M):
        here = [run for run in runs if run.wish.goal_m == goal_m]
        upper, lower = (figure.add_subplot(2, len(GOALS_M), row * len(GOALS_M) + column + 1) for row in (0, 1))
        _plot(upper, here, "speed (m/s)", [run.speeds_mps for run in here])
        _plot(lower, here, "acceleration (m/s2)", [run.accelerations_mps2 for run in here])
        upper.set_title(f"to a waypoint {goal_m:g} m ahead")
        lower.set_xlabel("time (s)")
    figure.suptitle(f"Thymio on a free way, seed {runs[0].wish.seed}")
    canvas.print_png(path)  # type: ignore[no-untyped-call]


def _plot(axes: "Axes", runs: Sequence[SpeedRun], label: str, values: Sequence[Sequence[float]]) -> None:
    axes.axhline(0.0, color="0.7", linewidth=1)
    for run, each in zip(runs, values, strict=True):
        axes.plot(run.times_s, each, color=_COLORS[run.wish.law], label=run.wish.law)
    axes.set_ylabel(label)
    axes.legend(loc="best")


# The text of docs/reference/results/behaviors.md, from the scores of its runs. Pure.


Results = Mapping[ScoreCase, Score]
SPEEDS: Final = "thymio-speeds.png"
NOT_MEASURED: Final = "not measured"
_ALSO_OF_BASELINES: Final = ("unseen_percent", "target_contacts")
_UNITS: Final = {**{name: figure.unit for name, figure in FIGURES.items()}, "unseen_percent": "%"}
_IN_LIGHT: Final = ("wrong_states_percent", "crossed_on_red", "crossed_late", "least_crossings", "start_s")


def picture_name(case: ScoreCase) -> str:
    """Return the file name of the picture of this run."""
    return "-".join(part for part in (case.scenario, case.robot and f"on-{case.robot}", case.mission) if part) + ".png"


def table_lines(table: Table, results: Results) -> Iterator[str]:
    """Yield the section of `table`: the worst start of each line, and the bound."""
    names = f"{table.seeds[0]} to {table.seeds[-1]}"
    yield f"## {table.title}\n"
    yield f"{table.summary}\nThe worst of {len(table.seeds)} starts (seeds {names}) with the default detector.\n"
    yield f"| scenario | look | {' | '.join(table.figures)} | |\n|---|---|{'---:|' * len(table.figures)}---|"
    for scenario, look in table.lines():
        runs = [results[case] for case in table.cases(scenario, look) if case in results]
        checks = [_table_checks(table, scenario, run) for run in runs]
        cells = " | ".join(f"{_worst(runs, name)} (bound {_bound(scenario, name)})" for name in table.figures)
        ok = all(check.ok for same in checks for check in same)
        yield f"| {scenario} | {look} | {cells} | {'ok' if runs and ok else '**not kept**' if runs else NOT_MEASURED} |"
    yield ""


def _table_checks(table: Table, scenario: str, run: Score) -> list[Check]:
    return [check for check in checks_of(load_scenario(scenario), run, LATENCY_MS) if check.name in table.figures]


def _bound(scenario: str, name: str) -> str:
    return _figure(load_scenario(scenario).bounds[name], _UNITS[name])


def _worst(runs: Sequence[Score], name: str) -> str:
    return _figure(median_and_worst(runs, name)[1], _UNITS[name]) if runs else NOT_MEASURED


def merged(old: str, new: str) -> str:
    """Return page `old` with the sections and the lines of the overview of `new`, in the order of a whole page."""
    (head, lines, sections), (_, newer_lines, newer) = _parts(old), _parts(new)
    lines, sections = lines | newer_lines, sections | newer
    titles = [*(row.title for row in ROWS), *(table.title for table in TABLES)]
    overview = [lines[title.replace("`", "")] for title in titles if title.replace("`", "") in lines]
    return "\n".join([head, *overview, "", *(sections[title] for title in titles if title in sections)])


def _parts(page: str) -> tuple[str, dict[str, str], dict[str, str]]:
    """Return the text before the lines of the overview, these lines and the sections, by title."""
    head, *sections = page.split("\n## ")
    begin, *lines = head.rstrip("\n").split("\n| [")
    by_title = {section.partition("\n")[0]: f"## {section}".rstrip("\n") + "\n" for section in sections}
    return begin, {line.partition("]")[0]: f"| [{line}" for line in lines}, by_title


def kept(row: Row, results: Results, seeds: Sequence[int]) -> bool:
    """Return True if every run was within every bound. A baseline has no bounds."""
    return bool(row.baseline) or all(
        check.ok for case in row.all_cases(seeds) for check in _checks(row, results[case])
    )


def page_lines(
    rows: Sequence[Row], results: Results, seeds: Sequence[int], folder: str, speeds: Sequence[SpeedRun],
    *, tables: Sequence[Table] = (),
) -> Iterator[str]:
    """Yield the page, block by block; pictures lie in `folder`."""
    names = ",".join(map(str, seeds))
    yield "# Behaviors\n"
    yield (
        f"Each scenario by name, in lockstep on {len(seeds)} starts (seeds {names}), +{LATENCY_MS:g} ms latency, "
        f"{LOSS:.0%} loss on each leg, scored from the\nworld's own record: the median over the starts, then "
        "the worst. A baseline is a legacy controller with its own numbers, next to the default\nmission. It has no "
        "bounds. Where a scenario leaves the detector, it is `hsv`.\n"
        "[Robots and scenarios](../robots-and-scenarios.md) describes each robot and scenario.\n"
    )
    yield (
        f"Written by `python -m docs.make.behaviors --seeds {names}`. Watch one with `sightline demo\n"
        "--scenario NAME`, score one with `sightline score --scenario NAME`. Times count from the start. Shares and "
        "errors count from the\nfirst acquisition to the end. A `least_` figure must not fall below its bound, the "
        "others must not exceed it. Contacts are\nphysics steps of 4 ms. `--only NAME` runs a scenario or the "
        "section NAME again.\n"
    )
    yield from _overview(rows, results, seeds)
    for row in rows:
        yield from (_baseline if row.baseline else _behavior)(row, results, seeds, folder)
        if row == Row("thymio") and speeds:
            yield from _speeds(speeds, folder)
    for table in tables:
        yield from table_lines(table, results)


def _overview(rows: Sequence[Row], results: Results, seeds: Sequence[int]) -> Iterator[str]:
    yield "| scenario | mission | starts within all bounds | figure nearest to its bound |\n|---|---|---:|---|"
    for row in (row for row in rows if not row.baseline):
        cases = row.all_cases(seeds)
        judged = [_checks(row, results[case]) for case in cases]
        good = sum(all(check.ok for check in checks) for checks in judged)
        yield (f"| [{row.title.replace('`', '')}](#{row.anchor}) | `{row.law}` | {good} of {len(cases)} | "
               f"{_tightest(row, [check for checks in judged for check in checks])} |")
    yield ""


def _tightest(row: Row, checks: Sequence[Check]) -> str:
    """Return the figure nearest to its bound, among those with a margin."""
    names = load_scenario(row.scenario).bounds.keys() - set(EXACT)
    shares = [(_share(check), check) for check in checks if check.name in names and check.value is not None]
    share, check = max(shares, key=lambda one: one[0], default=(0.0, None))
    return f"{check.name} {_figure(check.value, check.unit)}, {share:.0%}" if check else ""


def _share(check: Check) -> float:
    value = check.value or 0.0
    if not check.name.startswith("least_"):
        return value / check.bound
    return check.bound / value if value else 9.99


def _checks(row: Row, result: Score) -> list[Check]:
    return checks_of(load_scenario(row.scenario), result, LATENCY_MS)


def _head(row: Row) -> Iterator[str]:
    scenario = load_scenario(row.scenario)
    yield f"## {row.title}\n"
    yield (f"{scenario.summary[0].upper()}{scenario.summary[1:]}. Robot `{row.robot or scenario.robot}`, "
           f"mission `{row.law}`.\n")


def _behavior(row: Row, results: Results, seeds: Sequence[int], folder: str) -> Iterator[str]:
    yield from _head(row)
    yield "| figure | median | worst | bound | |\n|---|---:|---:|---:|---|"
    runs = [results[case] for case in row.cases(seeds)]
    for same in zip(*(_checks(row, run) for run in runs), strict=True):
        outcome = "ok" if all(check.ok for check in same) else "**not kept**"
        name = same[0].name
        yield f"| {name} | {_both(runs, name)} | {_figure(same[0].bound, same[0].unit)} | {outcome} |"
    if row.looks:
        yield from _in_other_light(row, results, seeds)
    yield _shown(row, seeds, folder)


def _in_other_light(row: Row, results: Results, seeds: Sequence[int]) -> Iterator[str]:
    """Yield the worst of each figure for the same starts in each light of `looks`."""
    yield (
        f"\nIn other light (`--look`), the worst of {len(seeds)} starts each. A frame is misread if it does not name "
        f"the lit color, from\n{SETTLED_S:g} s after each change and from {READ_WITHIN_M:g} m before the line. A "
        f"crossing is late if it is on yellow and a stop with {HARDEST_MPS2:g} m/s2 was possible.\n"
    )
    yield f"| look | {' | '.join(_IN_LIGHT)} | |\n|---|{'---:|' * len(_IN_LIGHT)}---|"
    for look in row.looks:
        runs = [results[case] for case in row.cases(seeds, look)]
        outcome = "ok" if all(check.ok for run in runs for check in _checks(row, run)) else "**not kept**"
        worst = [_figure(median_and_worst(runs, name)[1], _UNITS[name]) for name in _IN_LIGHT]
        yield f"| {look} | {' | '.join(worst)} | {outcome} |"


def _baseline(row: Row, results: Results, seeds: Sequence[int], folder: str) -> Iterator[str]:
    yield from _head(row)
    yield f"{CHARACTER[row.baseline]} {_failures(row, results, seeds)}\n"
    default = row.default
    yield f"| figure | `{row.law}` median | worst | `{default.law}` median | worst |\n|---|---:|---:|---:|---:|"
    runs, others = ([results[case] for case in one.cases(seeds)] for one in (row, default))
    names = [check.name for check in _checks(row, runs[0])]
    for name in [*names, *(name for name in _ALSO_OF_BASELINES if name not in names)]:
        yield f"| {name} | {_both(runs, name)} | {_both(others, name)} |"
    yield _shown(row, seeds, folder)


def _shown(row: Row, seeds: Sequence[int], folder: str) -> str:
    about = row.title.replace("`", "")
    return f"\n![{about}: the paths and the figures over time]({folder}/{picture_name(row.cases(seeds)[0])})\n"


def _failures(row: Row, results: Results, seeds: Sequence[int]) -> str:
    """Return the bounds that it would break, and how often."""
    judged = [_checks(row, results[case]) for case in row.cases(seeds)]
    broken = [(same[0].name, sum(not check.ok for check in same)) for same in zip(*judged, strict=True)]
    text = ", ".join(f"{name} ({count})" for name, count in broken if count)
    if not text:
        return f"It stays within all bounds of `{row.default.law}` here."
    return f"It breaks these bounds of `{row.default.law}`, with the number of {len(seeds)} starts: {text}."


def _speeds(speeds: Sequence[SpeedRun], folder: str) -> Iterator[str]:
    yield "### Speed and acceleration\n"
    yield ("The same robot to a waypoint straight ahead, with nothing in the way. `goto` is slow because its sensors "
           "reach only\n0.2 m: it must keep its clearance to objects just beyond. The legacy controller "
           "drives as if it had a longer range.\n")
    yield ("| mission | waypoint | arrived | top speed | largest acceleration | hardest braking | distance at end |\n"
           "|---|---:|---:|---:|---:|---:|---:|")
    for run in speeds:
        arrived = "never" if run.arrived_s is None else f"{run.arrived_s:.1f} s"
        yield (f"| `{run.wish.law}` | {run.wish.goal_m:g} m | {arrived} | {run.top_mps:.2f} m/s | "
               f"{max(run.accelerations_mps2):.2f} m/s2 | {-min(run.accelerations_mps2):.2f} m/s2 | "
               f"{run.off_m * 100:.1f} cm |")
    yield f"\n![speed and acceleration of both missions to three waypoints]({folder}/{SPEEDS})\n"


def _both(runs: Sequence[Score], name: str) -> str:
    median, worst = median_and_worst(runs, name)
    return f"{_figure(median, _UNITS[name])} | {_figure(worst, _UNITS[name])}"


def _figure(value: float | None, unit: str) -> str:
    return "never" if value is None else f"{number(value)} {unit}"


# docs/reference/results/behaviors.md: every behavior and its baseline in lockstep. Shell (files).
#
# An image is of the first seed. The page names the command that wrote it; all figures in it are generated.


def write_page(
    page: Path, seeds: Sequence[int], jobs: int, rows: Sequence[Row] = ROWS, tables: Sequence[Table] = (),
    *, only: bool = False,
) -> bool:
    """Run `rows` and `tables`. Write `page`, and its pictures to a folder next to it. True if all are within bounds.

    With `only` the page keeps its other parts.
    """
    wanted = list(dict.fromkeys((
        *(case for row in rows for case in row.all_cases(seeds)),
        *(case for table in tables for line in table.lines() for case in table.cases(*line)),
    )))
    wishes = speed_cases(seeds[0]) if any(row.scenario == "thymio" for row in rows) else []
    pictures = page.parent / page.stem
    pictures.mkdir(parents=True, exist_ok=True)
    shown = {case: pictures / picture_name(case) for row in rows for case in row.cases(seeds[:1])}
    results, speeds = _run_all(wanted, wishes, shown, jobs)
    if speeds:
        plot_speeds(pictures / SPEEDS, speeds)
    text = "\n".join(page_lines(rows, results, seeds, pictures.name, speeds, tables=tables)).rstrip() + "\n"
    page.write_text(merged(page.read_text("utf-8"), text) if only else text, "utf-8")
    return all(kept(row, results, seeds) for row in rows) and "**not kept**" not in text


def _run_all(
    wanted: Sequence[ScoreCase], wishes: Sequence[SpeedCase], shown: Mapping[ScoreCase, Path], jobs: int
) -> tuple[Results, list[SpeedRun]]:
    """Return the scores of `wanted` and the drives of `wishes`. Each run of `shown` writes its picture."""
    with progress_bar(len(wanted) + len(wishes)) as advance, worker_pool(jobs) as pool:
        runs = {pool.submit(_run, case, shown.get(case)): case for case in wanted}
        drives = [pool.submit(speed_run, wish) for wish in wishes]
        everything: list[Future[Any]] = [*runs, *drives]
        for future in as_completed(everything):
            future.result()  # a failed run ends the others here
            advance()
    return {case: run.result() for run, case in runs.items()}, [drive.result() for drive in drives]


def _run(case: ScoreCase, picture: Path | None) -> Score:
    scenario, run = run_of(case)
    if picture is not None:
        whose = f" on {case.robot}" if case.robot else ""
        law = case.mission or scenario.mission
        plot_run(picture, run.samples, scenario, f"{scenario.name}{whose}, {law}, seed {case.seed}")
    return score(scenario, run)


def main() -> int:
    """Run every behavior and its baseline, and write the page."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seeds", default="201,202,203,204,205,206", help="separated by commas")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at once")
    parser.add_argument("--only", default="", help="scenarios and titles of tables, separated by commas")
    given = parser.parse_args()
    names = given.only.split(",") if given.only else []
    rows = [row for row in ROWS if not names or row.scenario in names]
    tables = [table for table in TABLES if not names or table.title in names]
    if set(names) - {row.scenario for row in rows} - {table.title for table in tables}:
        parser.error(f"--only {given.only}: a name is not of this page")
    seeds = [int(seed) for seed in given.seeds.split(",")]
    return 0 if write_page(PAGE, seeds, given.jobs, rows, tables, only=bool(names)) else 5


if __name__ == "__main__":
    sys.exit(main())
