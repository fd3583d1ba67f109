"""The distributions of `bench loop` as an image: share of answers by age, and age over time. Shell (a file)."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from sightline.benchmarks.loop.figures import FLOOR, OLDER, OURS, LoopSetting
from sightline.benchmarks.loop.race import Race

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS: Final = {
    FLOOR: "floor (one process)", OURS: "sightline", "tcp": "bare TCP", "callback": "Zenoh, callback",
    "ring": "Zenoh, RingChannel(1)", "newest": "Zenoh, newest as zenoh-demos", "openpi": "WebSocket as openpi",
    "lekiwi": "ZeroMQ as LeKiwi", OLDER: "legacy article",
}
_PAUSE_US: Final = 2_000_000


def draw_race(path: Path, race: Race) -> None:
    """Write a PNG: on the left the share of results by age, on the right the age over time."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    shares, times = figure.subplots(1, 2)
    for name, sample in race.samples.items():
        if sample.course.ages_us:
            _draw_one(shares, times, name, sample.course.ages_us)
    _finish(shares, "age at the result, ms", "share of results, %")
    _finish(times, "seconds", "age at the result, ms")
    shares.set_xscale("log")
    times.set_yscale("log")
    for axis in (shares.xaxis, times.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    shares.legend(loc="lower right")
    setting = race.setting
    figure.suptitle(
        f"{setting.width_px}x{setting.height_px} at {setting.fps:g} fps, {setting.transport}, detector "
        f"{_slowness(setting)}, loopback"
    )
    canvas.print_png(path)  # type: ignore[no-untyped-call]


def _slowness(setting: LoopSetting) -> str:
    if setting.busy_ms:
        return f"busy {setting.busy_ms:.0f} ms"
    return f"+{setting.detector_delay_ms:g} ms" if setting.detector_delay_ms else "as it is"


def _draw_one(shares: "Axes", times: "Axes", name: str, ages_us: tuple[tuple[int, int], ...]) -> None:
    ages_ms = sorted(age_us / 1000 for _, age_us in ages_us)
    width = 2.5 if name == OURS else 1.2
    style = "--" if name in (FLOOR, "tcp") else ":" if name == OLDER else "-"
    percents = [100 * (at + 1) / len(ages_ms) for at in range(len(ages_ms))]
    shares.plot(ages_ms, percents, label=LABELS[name], linewidth=width, linestyle=style)
    times.plot(*_over_time(ages_us), linewidth=width, linestyle=style)


def _over_time(ages_us: tuple[tuple[int, int], ...]) -> tuple[list[float], list[float]]:
    """Return seconds and milliseconds. The line is broken during the turns of other contestants."""
    seconds, ages_ms = [], []
    before_us = begin_us = ages_us[0][0]
    for at_us, age_us in ages_us:
        if at_us - before_us > _PAUSE_US:
            seconds.append((at_us - begin_us) / 1e6)
            ages_ms.append(math.nan)
        seconds.append((at_us - begin_us) / 1e6)
        ages_ms.append(age_us / 1000)
        before_us = at_us
    return seconds, ages_ms


def _finish(axes: "Axes", across: str, up: str) -> None:
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(visible=True, which="both", alpha=0.3)
