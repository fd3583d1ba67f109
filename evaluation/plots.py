"""Draw the path of a run and its figures over time. Shell (writes a file)."""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from sightline.operator_side.preflight import needs
from sightline.sim.scenario import Scenario, Static, Wall
from sightline.sim.truth import Truth

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Circle

ROBOT_COLOR, TARGET_COLOR, WALL_COLOR = "tab:blue", "goldenrod", "0.55"
LIGHT_DRAWN_M = 0.06
STATE_COLORS: Final = {
    "ACTIVE": "tab:green", "DEGRADED": "gold", "HOLD": "tab:orange", "STOPPED": "tab:red", "FAULT": "tab:red",
    "DISARMED": "0.6",
}
_SCALE_LENGTHS_M: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


class StatusAt(NamedTuple):
    """State and frame age that the robot published. The age is None without a command in force."""

    t_us: int
    state: str
    frame_age_us: int | None


class AgeLimits(NamedTuple):
    """Frame ages of the robot, in ms: full speed up to the first, none from the second on."""

    full_ms: float
    zero_ms: float


def scale_length_m(span_m: float) -> float:
    """Choose a round length for the scale of a view that is `span_m` wide: at most a quarter of it."""
    return max((length for length in _SCALE_LENGTHS_M if length <= span_m / 4), default=_SCALE_LENGTHS_M[0])


def plot_run(
    path: Path, samples: Sequence[Truth], scenario: Scenario, title: str, *, statuses: Sequence[StatusAt] = (),
    limits: AgeLimits | None = None,
) -> None:
    """Draw `samples` (at least one), and frame age and state below if `statuses` and `limits` are given.

    Raises ConfigError without Matplotlib.
    """
    with needs("report"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(figsize=(12, 6), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    with_age = bool(statuses) and limits is not None
    grid = figure.add_gridspec(2 + with_age, 2, width_ratios=(1.1, 1))
    _plot_ways(figure.add_subplot(grid[:, 0]), samples, scenario)
    times_s = [(truth.t_us - samples[0].t_us) / 1e6 for truth in samples]
    upper, lower = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    if scenario.light:
        _plot_speed(upper, times_s, samples)
        _plot_line(lower, times_s, samples)
    elif scenario.goals_m:
        _plot_speed(upper, times_s, samples)
        _plot_clearance(lower, times_s, samples, scenario.bounds.get("least_clearance_m"))
    else:
        _plot_bearing(upper, times_s, samples)
        _plot_distance(lower, times_s, samples, scenario.stand_off_m)
    if with_age and limits is not None:
        _plot_age(figure.add_subplot(grid[2, 1]), samples, statuses, limits)
    figure.suptitle(title, parse_math=False)  # names may contain a dollar sign
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from")  # missing glyphs become boxes
        canvas.draw()  # type: ignore[no-untyped-call]  # equal scales change the tick labels; their size is known now
        canvas.print_png(path)  # type: ignore[no-untyped-call]


def wall_corners(wall: Wall) -> list[tuple[float, float]]:
    """Return the four corners of a wall seen from above, m."""
    (x1, y1), (x2, y2) = wall.start_m, wall.end_m
    length = math.hypot(x2 - x1, y2 - y1) or 1.0
    across_x, across_y = -(y2 - y1) / length * wall.thickness_m / 2, (x2 - x1) / length * wall.thickness_m / 2
    return [
        (x1 + across_x, y1 + across_y), (x2 + across_x, y2 + across_y),
        (x2 - across_x, y2 - across_y), (x1 - across_x, y1 - across_y),
    ]


def _plot_ways(axes: "Axes", samples: Sequence[Truth], scenario: Scenario) -> None:
    for number, wall in enumerate(scenario.walls):
        axes.fill(*zip(*wall_corners(wall), strict=True), color=WALL_COLOR, label="" if number else "wall")
    _plot_things(axes, scenario)
    if scenario.target.shape != "place":
        axes.plot([t.target_x_m for t in samples], [t.target_y_m for t in samples], color=TARGET_COLOR, label="target")
    axes.plot([t.x_m for t in samples], [t.y_m for t in samples], color=ROBOT_COLOR, label="robot")
    start, end = samples[0], samples[-1]
    axes.plot(start.x_m, start.y_m, "o", color=ROBOT_COLOR, label="start of the robot", linestyle="none")
    axes.annotate(
        "", (end.x_m + 0.15 * math.cos(end.yaw_rad), end.y_m + 0.15 * math.sin(end.yaw_rad)), (end.x_m, end.y_m),
        arrowprops={"arrowstyle": "-|>", "color": ROBOT_COLOR},
    )
    if scenario.target.shape != "place":
        axes.add_patch(_circle((end.target_x_m, end.target_y_m), scenario.target.reach_m, TARGET_COLOR))
    axes.set(xlabel="x (m)", ylabel="y (m)", title="from above")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(visible=True, color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    _plot_scale(axes)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize="small", frameon=False)


def _plot_scale(axes: "Axes") -> None:
    """Draw a bar of a round length above the view, where the plot is empty."""
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    axes.apply_aspect()  # equal scales change the limits
    left, right = axes.get_xlim()
    length_m = scale_length_m(right - left)
    bar = AnchoredSizeBar(
        axes.transData, length_m, f"{length_m:g} m", "lower left", pad=0.2, frameon=False,
        size_vertical=0.004 * (right - left), bbox_to_anchor=(0.0, 1.0), bbox_transform=axes.transAxes, borderpad=0.0,
    )
    axes.add_artist(bar)


def _plot_things(axes: "Axes", scenario: Scenario) -> None:
    """Draw the things without the offset of the seed, the waypoints, the light and its line."""
    standing = [thing for thing in scenario.things if isinstance(thing, Static)]
    for number, thing in enumerate(standing):
        circle = _circle(thing.at_m, thing.reach_m, WALL_COLOR)
        circle.set_label("" if number else "obstacle")
        axes.add_patch(circle)
    if scenario.goals_m:
        axes.plot(*zip(*scenario.goals_m, strict=True), "x", color=TARGET_COLOR, markersize=12, label="waypoint")
    if scenario.light:
        light = _circle(scenario.light.at_m, LIGHT_DRAWN_M, "black")
        light.set_label("traffic light and stop line")
        axes.add_patch(light)
        axes.plot(*zip(*scenario.light.stop_line_m(), strict=True), color="black")


def _circle(center: tuple[float, float], radius_m: float, color: str) -> "Circle":
    from matplotlib.patches import Circle

    return Circle(center, radius_m, color=color)


def _plot_bearing(axes: "Axes", times_s: list[float], samples: Sequence[Truth]) -> None:
    axes.axhline(0.0, color="0.7", linewidth=1)
    axes.plot(times_s, [math.degrees(truth.bearing_rad) for truth in samples], color=ROBOT_COLOR)
    axes.set(ylabel="bearing (deg)", title="bearing of the target")


def _plot_distance(axes: "Axes", times_s: list[float], samples: Sequence[Truth], stand_off_m: float) -> None:
    axes.axhline(stand_off_m, color="0.7", linewidth=1, label="stand-off")
    axes.plot(times_s, [truth.distance_m for truth in samples], color=ROBOT_COLOR)
    axes.set(xlabel="time (s)", ylabel="distance (m)", title="distance, lens to the target's center")
    axes.legend(loc="best")


def _plot_age(axes: "Axes", samples: Sequence[Truth], statuses: Sequence[StatusAt], limits: AgeLimits) -> None:
    """Plot frame age over time, its limits, and the state as background color."""
    begin_us, end_us = samples[0].t_us, samples[-1].t_us
    during = [one for one in statuses if begin_us <= one.t_us <= end_us]
    times_s = [(one.t_us - begin_us) / 1e6 for one in during]
    ends_s = [*times_s[1:], (end_us - begin_us) / 1e6]
    named: set[str] = set()
    for one, from_s, to_s in zip(during, times_s, ends_s, strict=False):
        label = "" if one.state in named else one.state
        named.add(one.state)
        axes.axvspan(from_s, to_s, color=STATE_COLORS.get(one.state, "0.6"), alpha=0.25, linewidth=0, label=label)
    ages_ms = [math.nan if one.frame_age_us is None else one.frame_age_us / 1000 for one in during]
    axes.plot(times_s, ages_ms, color=ROBOT_COLOR)
    for limit_ms, style in ((limits.full_ms, "--"), (limits.zero_ms, "-")):
        axes.axhline(limit_ms, color="0.4", linewidth=1, linestyle=style)
    axes.set_ylim(0, 1.5 * limits.zero_ms)
    axes.set(xlabel="time (s)", ylabel="frame age (ms)",
             title=f"frame age and state; limits {limits.full_ms:g} ms and {limits.zero_ms:g} ms")
    if named:  # without a status during the run, Matplotlib warns of an empty legend
        axes.legend(loc="upper right", ncols=4, fontsize="small")


def _plot_speed(axes: "Axes", times_s: list[float], samples: Sequence[Truth]) -> None:
    axes.plot(times_s, [truth.linear_mps for truth in samples], color=ROBOT_COLOR)
    axes.set(ylabel="speed (m/s)", title="speed")


def _plot_clearance(axes: "Axes", times_s: list[float], samples: Sequence[Truth], bound_m: float | None) -> None:
    axes.plot(times_s, [truth.clearance_m or 0.0 for truth in samples], color=ROBOT_COLOR)
    axes.set(xlabel="time (s)", ylabel="clearance (m)", title="clearance, body to the nearest obstacle")
    if bound_m is not None:
        axes.axhline(bound_m, color="0.7", linewidth=1, label="demanded")
        axes.legend(loc="best")


def _plot_line(axes: "Axes", times_s: list[float], samples: Sequence[Truth]) -> None:
    """Plot the distance of the front beyond the line, on the color of the light."""
    axes.axhline(0.0, color="black", linewidth=1)
    ways_m = [truth.past_line_m or 0.0 for truth in samples]
    for color, shown in (("red", "tab:red"), ("yellow", "gold"), ("green", "tab:green")):
        lit = [truth.light == color for truth in samples]
        axes.fill_between(times_s, min(ways_m), max(ways_m), where=lit, color=shown, alpha=0.25, linewidth=0)
    axes.plot(times_s, ways_m, color=ROBOT_COLOR)
    axes.set(xlabel="time (s)", ylabel="beyond the line (m)", title="the robot's front and the stop line")
