"""thymio-speeds.png: speed and acceleration over time, a column per waypoint, both laws. Shell (writes a file)."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sightline.operator_side.preflight import needs
from sightline.evaluation.plots import ROBOT_COLOUR
from sightline.operator_side.speed_runs import GOALS_M, LAWS, SpeedRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = dict(zip(LAWS, (ROBOT_COLOUR, "tab:red"), strict=True))


def plot_speeds(path: Path, runs: Sequence[SpeedRun]) -> None:
    """Draw `runs`. Raises ConfigError without Matplotlib."""
    with needs("report"):
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
        axes.plot(run.times_s, each, color=_COLOURS[run.wish.law], label=run.wish.law)
    axes.set_ylabel(label)
    axes.legend(loc="best")
