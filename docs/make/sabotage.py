"""Write docs/reference/results/sabotage.md: every scenario with every sabotage, and without one. Shell.

    python -m docs.make.sabotage --seeds 7101,7102,7103,7104,7105,7106
"""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from sightline.evaluation.score.runs import (
    SabotagedPair,
    ScoredFigure,
    cases,
    run_all_sabotaged,
    run_cases,
    sabotaged,
)
from sightline.evaluation.score.sabotage import SABOTAGES, reason_of
from sightline.operator_side.terminal import progress_bar
from sightline.sim.scenario import scenario_names

PAGE: Final = Path(__file__).parents[1] / "reference" / "results" / "sabotage.md"
LATENCY_MS, LOSS = 50.0, 0.1
MEANINGS: Final = {
    "steering-flipped": "the motors are swapped",
    "detector-blind": "the detector finds nothing",
    "detector-wrong-object": "each object is found a quarter of the image beside its place",
    "wheels-dead": "the motors do not turn",
    "one-wheel-dead": "the right motor does not turn",
    "robot-only-rotates": "the robot turns, but does not drive",
    "frames-frozen": "the camera repeats its first image",
    "answers-late": "each answer comes 1 s late",
    "odometry-random": "the encoders report random angles",
    "range-blind": "the range sensor reports no obstacle",
}


def page_lines(
    healthy: Sequence[ScoredFigure], pairs: Sequence[SabotagedPair], names: Sequence[str], seeds: Sequence[int]
) -> Iterator[str]:
    """Yield the page, block by block."""
    listed = ",".join(map(str, seeds))
    only = "" if list(names) == scenario_names() else f" --scenario {','.join(names)}"
    yield "# Sabotage of the score\n"
    yield (f"Each listed scenario runs with one broken part, in lockstep from seeds {listed}, "
           f"+{LATENCY_MS:g} ms latency,\n{LOSS:.0%} loss on each leg. The score must notice it in each run. A cell "
           "names the bound that broke, over all starts.\nA pair in which nothing can change runs from the first seed "
           "alone. The detector is that of the scenario, or else the default one.\n")
    yield (f"Written by `python -m docs.make.sabotage --seeds {listed}{only}`.\n"
           "Break one yourself with `sightline score --scenario NAME --sabotage NAME`.\n")
    yield "| sabotage | broken part |\n|---|---|"
    yield from (f"| `{name}` | {meaning} |" for name, meaning in MEANINGS.items())
    yield ""
    yield f"| scenario | healthy | {' | '.join(SABOTAGES)} |\n|---|---|{'---|' * len(SABOTAGES)}"
    reasons: list[str] = []
    for name in names:
        cells = [_cell(_found(pairs, name, sabotage), reasons) for sabotage in SABOTAGES]
        yield f"| {name} | {_healthy(healthy, name)} | {' | '.join(cells)} |"
    yield ""
    yield from (f"{number}. {reason}" for number, reason in enumerate(reasons, start=1))


def _found(pairs: Sequence[SabotagedPair], scenario: str, sabotage: str) -> SabotagedPair:
    return next(pair for pair in pairs if (pair.scenario, pair.sabotage) == (scenario, sabotage))


def _healthy(figures: Sequence[ScoredFigure], scenario: str) -> str:
    wrong = [one.name for one in figures if one.group.split()[0] == scenario and not one.ok]
    return f"**{', '.join(wrong)}**" if wrong else "ok"


def _cell(pair: SabotagedPair, reasons: list[str]) -> str:
    if pair.is_unchanged:
        reason = f"The run equals the healthy run byte for byte: {reason_of(pair.sabotage, pair.scenario)}."
        if reason not in reasons:
            reasons.append(reason)
        return f"unchanged ({reasons.index(reason) + 1})"
    broken = ", ".join(dict.fromkeys(run.broken[0] for run in pair.runs if run.broken))
    return broken if pair.ok else f"**{len(pair.runs) - pair.failed} of {len(pair.runs)} pass** {broken}".rstrip()


def write_page(page: Path, seeds: Sequence[int], jobs: int, names: Sequence[str]) -> bool:
    """Run everything and write `page`. Returns True if each sabotage was noticed and no healthy run failed."""
    wanted = cases(names, seeds, [LATENCY_MS], [LOSS], None)
    broken = sabotaged(wanted, list(SABOTAGES))
    with progress_bar(len(wanted) + len(broken)) as advance:
        noticed = run_all_sabotaged(broken, jobs, lambda _case: advance())
        healthy = run_cases(wanted, jobs, lambda _case: advance())
    page.write_text("\n".join(page_lines(healthy.scored, noticed.pairs, names, seeds)) + "\n", "utf-8")
    return healthy.ok is True and noticed.ok is True


def main() -> int:
    """Run every scenario with every sabotage, and write the page."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seeds", default="7101,7102,7103,7104,7105,7106", help="separated by commas")
    parser.add_argument("--scenario", default="all", help="all, or names separated by commas")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at once")
    given = parser.parse_args()
    seeds = [int(seed) for seed in given.seeds.split(",")]
    names = scenario_names() if given.scenario == "all" else given.scenario.split(",")
    return 0 if write_page(PAGE, seeds, given.jobs, names) else 5


if __name__ == "__main__":
    sys.exit(main())
