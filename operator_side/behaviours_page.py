"""The text of docs/behaviours.md, from the scores of its runs. Pure."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from sightline.evaluation.score.behaviours import CHARACTER, LATENCY_MS, LOSS, Row
from sightline.evaluation.checks import Check, number
from sightline.evaluation.score.figures import Score, median_and_worst
from sightline.operator_side.score_bounds import BOUNDS, EXACT, UNITS, checks_of
from sightline.operator_side.score_course import HARDEST_MPS2, READ_WITHIN_M, SETTLED_S
from sightline.evaluation.score.runs import Case
from sightline.operator_side.speed_runs import SpeedRun
from sightline.sim.scenario import load_scenario

Results = Mapping[Case, Score]
SPEEDS: Final = "thymio-speeds.png"
_ALSO_OF_BASELINES: Final = ("unseen_percent", "target_contacts")
_UNITS: Final = {**UNITS, "unseen_percent": "%"}
_IN_LIGHT: Final = ("wrong_states_percent", "crossed_on_red", "crossed_late", "least_crossings", "start_s")


def picture_name(case: Case) -> str:
    """The file of the picture of this run."""
    return "-".join(part for part in (case.scenario, case.robot and f"on-{case.robot}", case.mission) if part) + ".png"


def kept(row: Row, results: Results, seeds: Sequence[int]) -> bool:
    """Whether every run kept every bound; nothing is demanded of a baseline."""
    return bool(row.baseline) or all(
        check.ok for case in row.all_cases(seeds) for check in _checks(row, results[case])
    )


def page_lines(
    rows: Sequence[Row], results: Results, seeds: Sequence[int], folder: str, speeds: Sequence[SpeedRun]
) -> Iterator[str]:
    """The page, block by block; pictures lie in `folder`."""
    names = ",".join(map(str, seeds))
    yield "# Behaviours\n"
    yield (
        f"Every behaviour by name, in lockstep on {len(seeds)} starts (seeds {names}), +{LATENCY_MS:g} ms latency, "
        f"{LOSS:.0%} loss on each leg, judged from\nworld truth: the median over the starts, then the worst. A "
        "baseline is an older write-up's law with its own numbers, beside what drives\nby default; nothing is "
        "demanded of it. [robots.md](robots.md) says what each robot and scenario is, and whose it was.\n"
    )
    yield (
        f"Written by `sightline score --page docs/behaviours.md --seeds {names}`. See one with `sightline demo\n"
        "--scenario NAME`, judge one with `sightline score --scenario NAME`. Times count from the start, shares and "
        "errors from the first\nacquisition to the end; a `least_` figure must not fall below its bound, every other "
        "must not exceed it; contacts are physics\nsteps of 4 ms.\n"
    )
    yield from _overview(rows, results, seeds)
    for row in rows:
        yield from (_baseline if row.baseline else _behaviour)(row, results, seeds, folder)
        if row == Row("thymio") and speeds:
            yield from _speeds(speeds, folder)


def _overview(rows: Sequence[Row], results: Results, seeds: Sequence[int]) -> Iterator[str]:
    yield "| scenario | law | starts that kept every bound | most of a bound that was used |\n|---|---|---:|---|"
    for row in (row for row in rows if not row.baseline):
        cases = row.all_cases(seeds)
        judged = [_checks(row, results[case]) for case in cases]
        good = sum(all(check.ok for check in checks) for checks in judged)
        yield (f"| [{row.title.replace('`', '')}](#{row.anchor}) | `{row.law}` | {good} of {len(cases)} | "
               f"{_tightest(row, [check for checks in judged for check in checks])} |")
    yield ""


def _tightest(row: Row, checks: Sequence[Check]) -> str:
    """The figure that came nearest to its bound, of those that leave room."""
    names = set(BOUNDS[row.scenario]) - set(EXACT)
    shares = [(_share(check), check) for check in checks if check.name in names and check.value is not None]
    share, check = max(shares, key=lambda one: one[0], default=(0.0, None))
    return f"{check.name} {_figure(check.value, check.unit)}, {share:.0%}" if check else ""


def _share(check: Check) -> float:
    value = check.value or 0.0
    if not check.name.startswith("least_"):
        return value / check.bound
    return check.bound / value if value else 9.99


def _checks(row: Row, result: Score) -> list[Check]:
    return checks_of(row.scenario, result, LATENCY_MS)


def _head(row: Row) -> Iterator[str]:
    scenario = load_scenario(row.scenario)
    yield f"## {row.title}\n"
    yield (f"{scenario.summary[0].upper()}{scenario.summary[1:]}. Robot `{row.robot or scenario.robot}`, law "
           f"`{row.law}`.\n")


def _behaviour(row: Row, results: Results, seeds: Sequence[int], folder: str) -> Iterator[str]:
    yield from _head(row)
    yield "| figure | median | worst | bound | |\n|---|---:|---:|---:|---|"
    runs = [results[case] for case in row.cases(seeds)]
    for same in zip(*(_checks(row, run) for run in runs), strict=True):
        verdict = "ok" if all(check.ok for check in same) else "**not kept**"
        name = same[0].name
        yield f"| {name} | {_both(runs, name)} | {_figure(same[0].bound, same[0].unit)} | {verdict} |"
    if row.looks:
        yield from _in_other_light(row, results, seeds)
    yield _shown(row, seeds, folder)


def _in_other_light(row: Row, results: Results, seeds: Sequence[int]) -> Iterator[str]:
    """The same starts in each light of `looks`: the worst of each figure."""
    yield (
        f"\nIn other light (`--look`), the worst of {len(seeds)} starts each. A frame is misread if it does not name "
        f"the lit colour, from\n{SETTLED_S:g} s after each change and from {READ_WITHIN_M:g} m before the line on; "
        f"late is who crosses on yellow and could have stopped with {HARDEST_MPS2:g} m/s2.\n"
    )
    yield f"| look | {' | '.join(_IN_LIGHT)} | |\n|---|{'---:|' * len(_IN_LIGHT)}---|"
    for look in row.looks:
        runs = [results[case] for case in row.cases(seeds, look)]
        verdict = "ok" if all(check.ok for run in runs for check in _checks(row, run)) else "**not kept**"
        worst = [_figure(median_and_worst(runs, name)[1], _UNITS[name]) for name in _IN_LIGHT]
        yield f"| {look} | {' | '.join(worst)} | {verdict} |"


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
    return f"\n![{about}: the ways and the figures over time]({folder}/{picture_name(row.cases(seeds)[0])})\n"


def _failures(row: Row, results: Results, seeds: Sequence[int]) -> str:
    """Which of the bounds it would break, and how often."""
    judged = [_checks(row, results[case]) for case in row.cases(seeds)]
    broken = [(same[0].name, sum(not check.ok for check in same)) for same in zip(*judged, strict=True)]
    said = ", ".join(f"{name} ({count})" for name, count in broken if count)
    if not said:
        return f"It keeps every bound of `{row.default.law}` here."
    return f"Of the bounds of `{row.default.law}` it breaks, on so many of {len(seeds)} starts: {said}."


def _speeds(speeds: Sequence[SpeedRun], folder: str) -> Iterator[str]:
    yield "### Speed and acceleration\n"
    yield ("The same robot to a waypoint straight ahead, with nothing in the way. `goto` is as slow as its sensors are "
           "short-sighted: whatever\nstands just beyond their 0.2 m must still be left its clearance. The older law "
           "drives as if it saw further.\n")
    yield ("| law | waypoint | arrived | top speed | most acceleration | hardest braking | off at the end |\n"
           "|---|---:|---:|---:|---:|---:|---:|")
    for run in speeds:
        arrived = "never" if run.arrived_s is None else f"{run.arrived_s:.1f} s"
        yield (f"| `{run.wish.law}` | {run.wish.goal_m:g} m | {arrived} | {run.top_mps:.2f} m/s | "
               f"{max(run.accelerations_mps2):.2f} m/s2 | {-min(run.accelerations_mps2):.2f} m/s2 | "
               f"{run.off_m * 100:.1f} cm |")
    yield f"\n![speed and acceleration of both laws on three ways]({folder}/{SPEEDS})\n"


def _both(runs: Sequence[Score], name: str) -> str:
    median, worst = median_and_worst(runs, name)
    return f"{_figure(median, _UNITS[name])} | {_figure(worst, _UNITS[name])}"


def _figure(value: float | None, unit: str) -> str:
    return "never" if value is None else f"{number(value)} {unit}"
