"""Write docs/reference/results/performance.md from the JSON that its commands print. Shell.

    python -m docs.make.performance                  # all sections: over an hour
    python -m docs.make.performance loop watchers    # these; the other sections stay as they are
"""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from sightline.evaluation.processes import SIGHTLINE
from sightline.operator_side.cli.options import CHECK_FAILED
from sightline.protocol.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Section:
    """One command of the page and its reason. `name` is its argument of this script.

    With a `picture` the command gets `--out`, and its loop.png is shown under that name. `since` is the date of the
    last change of its figures or bounds; the page marks an earlier measurement.
    """

    name: str
    title: str
    why: str
    arguments: tuple[str, ...]
    picture: str = ""
    since: str = ""


_SEEDS: Final = "201,202,203,204,205,206"
_BALLS: Final = "behind,circle,eight,pushed,static,walls"
"""All others are in docs/reference/results/behaviors.md."""


def _rows(*names: str, extra: tuple[str, ...] = (), seconds: int = 60) -> tuple[str, ...]:
    only = [part for name in names for part in ("--only", name)]
    return ("bench", "network", *only, *extra, "--seconds", f"{seconds}")


SECTIONS: Final = (
    Section(
        "following",
        "Following, in virtual time",
        "The logic of the services in lockstep with the simulated world, scored from the world's own record by the "
        "worst run. Nothing was tuned on these seeds. Loss is on each leg.",
        ("score", "--scenario", _BALLS, "--seeds", _SEEDS, "--latency-ms", "50", "--loss", "0.1"),
    ),
    Section(
        "eight",
        "A figure of eight under latency",
        "Added latency from capture to command, half on each leg. At 400 ms no frame is young enough, so the robot "
        "must stand still.",
        ("score", "--scenario", "eight", "--seeds", _SEEDS, "--latency-ms", "0,100,200,400", "--loss", "0.1"),
    ),
    Section(
        "demo",
        "The same in real time",
        "`sightline demo`: real processes over Zenoh. The median of six seeds must stay within 1.5 times the bounds "
        "above. The recorded frames of each run, replayed through a fresh pipeline, must give the twists that were "
        "on the wire.",
        ("bench", "demo", "--scenario", _BALLS, "--seeds", _SEEDS, "--seconds", "12"),
        since="2026-11-26",
    ),
    Section(
        "demo-loss",
        "A lossy link in real time",
        "One minute of `sightline demo`: a fifth of the messages is lost on each leg, with 50 ms of latency. Loss must "
        "not stop the robot more than once. *Holds* counts the HOLDs in the log of the robot after its first motion.",
        ("demo", "--loss", "0.2", "--latency-ms", "50", "--seconds", "60"),
        since="2026-11-28",
    ),
    Section(
        "killed",
        "Killed at speed",
        "The vision service and the network process, killed with -9 while driving at 0.3 m/s or more, ten times "
        "each, scored from the log of the simulated motors. [Fault results](faults.md) has more faults.",
        ("faults", "--only", "vision.kill", "--only", "network.kill", "--only", "vision.restart", "--repeat", "10"),
        since="2026-11-28",
    ),
    Section(
        "gate", "Gate",
        "One command validated and one step decided, and the proof of a command after 63 lost ones: the most hashes.",
        ("bench", "gate"),
    ),
    Section("messages", "Messages", "Encode and decode, hot.", ("bench", "codec")),
    Section(
        "vision",
        "Vision",
        "`Pipeline.step` with decoding, and the network of the learned detector: hot, one thread. Medians count. The "
        "best round of a dozen frames is the time while a shared machine is least disturbed.",
        ("bench", "pipeline"),
        since="2026-11-30",  # the model changed later on the day of the last measurement
    ),
    Section(
        "loop",
        "The whole loop",
        "Capture to `drive.set` over Zenoh, by the motor log; for a rival, to the command in its robot process. Robot "
        "and vision service run in their own processes on this machine. Next to them run the floor (the same "
        "pipeline in one process at the same pace), plain TCP, three usual ways to receive Zenoh's images, the "
        "WebSocket request of openpi, the ZeroMQ of LeKiwi, and the legacy pipeline (`older`), on the same images in "
        "the same run. All but the legacy pipeline have Sightline's detector and steering, but no rival has credit, "
        "an age limit or a safety gate. *Answered* is of the images that the camera offers. *Unpaced* has no bound: "
        "it is the pipeline, one step after the other. A row is marked as disturbed if others had more than 5 % of the "
        "machine, or if the run had to shorten the sample. `benchmarks/peers/` names the sources.",
        ("bench", "loop", "--seconds", "15"),
        "loop-zenoh.png",
        since="2026-11-28",
    ),
    Section(
        "loop-websocket",
        "The whole loop over WebSocket",
        "The same with `sightline.v1` between robot and vision.",
        ("bench", "loop", "--transport", "websocket", "--seconds", "15"),
        "loop-websocket.png",
        since="2026-11-28",
    ),
    Section(
        "loop-wait",
        "Five thousand commands",
        "The longest time from the validation of a command to its `drive.set`: no command waits for a tick.",
        ("bench", "loop", "--peers", "none", "--seconds", "168"),
        since="2026-11-29",
    ),
    Section(
        "loop-slow",
        "A detector of 80 ms",
        "Each detector waits 80 ms longer, as for an accelerator, while 30 images per second arrive. The age must "
        "stay flat.",
        ("bench", "loop", "--detector-delay-ms", "80", "--seconds", "60"),
        "loop-slow.png",
        since="2026-11-28",
    ),
    Section(
        "loop-overload",
        "A color detector, overloaded twice by the frame rate",
        "60 images per second for detectors that need 33.3 ms for each one. The robot sends at most 240 per second, "
        "which the unchanged pipeline can process, so each detector repeats its own work instead.",
        ("bench", "loop", "--overload", "2", "--fps", "60", "--seconds", "60"),
        "loop-overload.png",
        since="2026-11-28",
    ),
    Section(
        "watchers",
        "Viewers",
        "Ten viewers of the control stream itself, one that never reads and one that reads once a second, and what "
        "they cost the driver.",
        ("bench", "watchers", "--viewers", "10", "--seconds", "60"),
        since="2026-11-28",
    ),
    Section(
        "watchers-websocket",
        "Viewers over WebSocket",
        "The same with `sightline.v1`.",
        ("bench", "watchers", "--transport", "websocket", "--viewers", "10", "--seconds", "60"),
        since="2026-11-28",
    ),
    Section(
        "network",
        "Slow and lossy networks",
        "Robot and vision service in two network namespaces, as on two machines. Each packet crosses a wire that "
        "loses and delays it. Ages count from capture to `drive.set`. Where packets are lost, five seeds "
        "run, and each bound applies to the worst.",
        _rows("radio", "bursts", "thin", "through", "step", "rise", extra=("--seeds", "1,2,3,4,5")),
        since="2026-11-28",
    ),
    Section(
        "network-far",
        "Far and broken networks",
        "The same wire without loss: a round trip of 2, 40 and 200 ms, five seconds without a wire, and one.",
        _rows("near", "rtt40", "rtt200", "cut", "nothing", seconds=30),
        since="2026-11-28",
    ),
    Section(
        "network-sites",
        "Several machines",
        "The same wire. A robot stands and turns again in `standby`, `router` and `moved`, scored from its wheel "
        "commands. In `fleet` one process plays the forty robots, with sessions, headers and credit of their own: "
        "eighty robot processes on two cores would measure themselves.",
        _rows("uplink", "standby", "router", "moved", "fleet"),
        since="2026-11-28",
    ),
    Section(
        "network-shared",
        "Vision services that share robots",
        "Twenty robots with their real gates at 15 images per second of 320x240, all processes of a site together on "
        "this machine, while services, routers and links fail or leave. A robot stands while its gate holds it. *Two "
        "drivers at once* counts the sessions that drive a robot again after another one. In `shared-loaded` each "
        "service has a detector that takes 8 ms, so that one service alone is too slow; its rate has no bound.",
        _rows(*(f"shared-{name}" for name in (
            "killed", "rolling", "scaled", "frozen", "cut", "alone", "router", "router-frozen", "parted", "joined",
            "loaded")), seconds=120),
        since="2026-11-28",
    ),
    Section(
        "network-stop",
        "STOP through a full medium",
        "One medium of 1 Mbit/s that both directions share, packet after packet, with video offered at 4 Mbit/s. "
        "Behind it an operator sends STOP, resets and sends it again. Times count from the request to the log of the "
        "simulated motors.",
        ("bench", "network", "--only", "medium", "--seconds", "120"),
    ),
    Section(
        "network-websocket",
        "The same networks over WebSocket",
        "With `sightline.v1` between robot and vision; rows with a router or a fleet need Zenoh.",
        ("bench", "network", "--transport", "websocket", "--seeds", "1,2,3,4,5", "--seconds", "60"),
        since="2026-11-28",
    ),
)


# Writes docs/reference/results/performance.md: runs the commands in turn, and records their output.
#
# All figures in the page are generated: the command measured them, on the date and machine that
# its section names.


PAGE: Final = Path(__file__).parents[1] / "reference" / "results" / "performance.md"
_HEADING: Final = "## "
_HEAD: Final = (
    "# Performance\n\nWritten by `python -m docs.make.performance`, section by section. Each section states when and "
    "on which machine it was measured. Shared machines are noisy: read medians and ratios, not third digits."
)
_EARLIER: Final = "Measured with an earlier command, or with earlier figures and bounds."
_MEASURED: Final = re.compile(r"^Measured (\d{4}-\d\d-\d\d)", re.MULTILINE)
_PACKAGES: Final = ("eclipse-zenoh", "pydantic", "numpy", "opencv-python-headless", "simplejpeg", "onnxruntime",
                    "pybullet")


def sections_named(names: Sequence[str]) -> tuple[Section, ...]:
    """Return the sections of `names` in the order of the page, or all. Raises ConfigError for an unknown name."""
    known = [section.name for section in SECTIONS]
    for name in names:
        if name not in known:
            raise ConfigError(f"unknown section {name!r}; expected one of {', '.join(known)}")
    return tuple(section for section in SECTIONS if not names or section.name in names)


def write_report(path: Path, sections: Sequence[Section], say: Callable[[str], None]) -> bool:
    """Run each section's command and write its section; other sections stay. Returns True if all checks passed.

    Writes after each section, so that a later failure loses nothing.
    """
    ok = True
    for section in sections:
        say(f"sightline {' '.join(section.arguments)}")
        result = _measured(section, path.parent / "img")
        ok &= bool(result["ok"])
        written = path.read_text("utf-8") if path.exists() else ""
        path.write_text(noted(f"{written}\n{_section(section, result)}"), "utf-8")
    return ok


def noted(page: str) -> str:
    """Return `page` in the order of `SECTIONS`, unknown sections last, with marks for missing and outdated sections.

    Of two sections with one title the last one counts.
    """
    parts = {part.partition("\n")[0]: part.rstrip() for part in page.split(f"\n{_HEADING}")[1:]}
    known = {one.title: one for one in SECTIONS}
    titles = [title for title in known if title in parts]
    missing = [title for title in known if title not in parts]
    head = [_HEAD, *([f"Not measured yet: {', '.join(missing)}."] if missing else [])]
    titles += [title for title in parts if title not in titles]
    texts = [_HEADING + _marked(parts[title], known.get(title)) for title in titles]
    return "\n\n\n".join(["\n\n".join(head), *texts]) + "\n"


def _marked(text: str, section: Section | None) -> str:
    """Add the note to a section whose command or instrument has changed since its date, or that no longer exists."""
    text = text.replace(f"{_EARLIER}\n\n", "")
    measured = _MEASURED.search(text)
    is_new = section is not None and measured is not None and measured[1] >= section.since and _command(section) in text
    return text if measured is None or is_new else text[:measured.start()] + f"{_EARLIER}\n\n" + text[measured.start():]


def _measured(section: Section, pictures: Path) -> dict[str, Any]:
    """Return the command's result. Copies its picture, if any, to where the page shows it."""
    if not section.picture:
        return _run(section.arguments)
    with tempfile.TemporaryDirectory(prefix="sightline-report-") as folder:
        result = _run((*section.arguments, "--out", folder))
        pictures.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(Path(folder) / "loop.png", pictures / section.picture)
    return result


def _run(arguments: Sequence[str]) -> dict[str, Any]:
    """Return the command's JSON object. Raises RuntimeError with its error line if it printed none."""
    done = subprocess.run([*SIGHTLINE, *arguments, "--json"], capture_output=True, text=True, check=False)
    if done.returncode not in (0, CHECK_FAILED):
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr.strip()}")
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _machine() -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    return (
        f"{datetime.now(UTC):%Y-%m-%d}, {processor()}, {os.cpu_count()} cores, Linux {platform.release()}, "
        f"Python {platform.python_version()}, {packages}."
    )


def processor() -> str:
    """Return the CPU's name, and its family and model: virtual machines give CPUs of several generations one name."""
    table = Path("/proc/cpuinfo")
    known = dict(re.findall(r"^([^\t:]+)\t*: (.+)$", table.read_text(), re.MULTILINE)) if table.exists() else {}
    name = known.get("model name", platform.machine())
    return f"{name} (family {known['cpu family']}, model {known['model']})" if "cpu family" in known else name


def _command(section: Section) -> str:
    return f"`sightline {' '.join(section.arguments)}`"


def _section(section: Section, result: dict[str, Any]) -> str:
    with_median = any("median" in check for check in result["checks"])
    head = "| figure | median | worst | bound | |" if with_median else "| figure | value | bound | |"
    rows = [_row(check, with_median) for check in result["checks"]]
    rule = "|---" * (head.count("|") - 1) + "|"
    shown = [f"![Age of the frames at the wheels](img/{section.picture})\n"] if section.picture else []
    race = [*_race(result["contestants"]), ""] if "contestants" in result else []
    intro = [f"{_HEADING}{section.title}\n", f"{section.why}\n", f"{_command(section)}\n", f"Measured {_machine()}\n"]
    return "\n".join([*intro, *race, *shown, head, rule, *rows])


def _race(contestants: Sequence[dict[str, Any]]) -> list[str]:
    """Return one row for each contestant of `bench loop`."""
    heads = ("", "answered %", "fps", "p50 ms", "p95 ms", "p99 ms", "validated p50 ms", "unpaced p50 ms",
             "bytes a picture", "CPU ms a picture", "memory MB")
    rows = [
        (f"{one['name']}{' (disturbed)' * one['is_disturbed']}", *(_number(one[key]) for key in (
            "answered_percent", "fps", "p50_ms", "p95_ms", "p99_ms", "validated_ms", "hot_ms")),
         "none" if one["bytes_per_picture"] is None else f"{one['bytes_per_picture']:.0f}",
         *(_by_process(one[key]) for key in ("cpu_ms", "memory_mb")))
        for one in contestants
    ]
    return [f"| {' | '.join(cells)} |" for cells in (heads, ("---",) * len(heads), *rows)]


def _by_process(figures: dict[str, float]) -> str:
    return ", ".join(f"{process} {_number(figure)}" for process, figure in figures.items())


def _row(check: dict[str, Any], with_median: bool) -> str:
    cells = [check["name"], *([_number(check.get("median"))] if with_median else []), _number(check["value"])]
    bound = f"{_number(check['bound'])} {check['unit']}"
    return "| " + " | ".join([*cells, bound, "ok" if check["ok"] else "**not reached**"]) + " |"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def main(names: Sequence[str]) -> int:
    """Measure the named sections, or all, and write them into the page."""
    return 0 if write_report(PAGE, sections_named(names), print) else CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
