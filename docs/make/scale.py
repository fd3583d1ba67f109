"""Write the tables of docs/how-to/scale.md from measured figures and prices. Shell.

    python -m docs.make.scale                                     # write the tables of the page
    python -m docs.make.scale --print --fps 15 --core-hour 0.02   # print them for other values
    python -m docs.make.scale --measure                           # measure the cost of a frame for a router: 20 s

The figures come from docs/reference/results/performance.md and router.json next to it. Prices and the speed of a GPU
are examples: pass your own.
"""

import argparse
import json
import math
import os
import platform
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from docs.make.performance import processor
from sightline.evaluation.processes import SIGHTLINE

DOCS: Final = Path(__file__).parents[1]
PAGE: Final = Path("how-to", "scale.md")
PERFORMANCE: Final = Path("reference", "results", "performance.md")
ROUTER: Final = Path("reference", "results", "router.json")
ROBOTS: Final = (1, 50, 500, 5_000)
MARKS: Final = re.compile(r"(<!-- scale[^\n]*-->\n).*?(<!-- /scale -->)", re.DOTALL)
MAX_SESSIONS: Final = 1_000
SPARE_SESSIONS: Final = 50
"""Sessions of a router for viewers, operators, recorders, detector services and the other router."""


@dataclass(frozen=True)
class Figures:
    """Measured inputs."""

    frame_bytes: float
    """Bytes of one 640x480 frame with its header and answer."""
    vision_ms: float
    """CPU time of a vision service for one such frame: receive, decode, color detector, track, steer, answer."""
    hsv_ms: float
    """The color detector at 320x240, decoding included."""
    onnx_ms: float
    """The learned detector at 320x240, decoding included."""
    memory_mb: float
    """Memory of a vision service."""
    router_us: float
    """CPU time of a router for one such frame and its answer."""
    router_date: str


@dataclass(frozen=True)
class Assumptions:
    """Inputs that are not measured: prices, loads and a GPU."""

    fps: float = 30.0
    busy: float = 0.6
    """Share of a core and of a network card that the plan uses."""
    nic_gbit: float = 10.0
    core_hour: float = 0.04
    gpu_hour: float = 1.0
    gigabyte: float = 0.0
    gpu_fps: float = 1_000.0


HELP: Final = {
    "fps": "frames per second of a robot", "busy": "planned load of cores and network cards",
    "nic_gbit": "network card of a router, Gbit/s", "core_hour": "price of a core for an hour",
    "gpu_hour": "price of a GPU for an hour", "gigabyte": "price of a transferred gigabyte",
    "gpu_fps": "frames per second of a GPU",
}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """The resources for a number of robots."""

    robots: int
    frames_s: float
    mbit_s: float
    sites: int
    """Pairs of routers, each with its own robots and vision services; 0 if the robot connects to its vision service."""
    router_cores: int
    services: int
    """Vision services of one core each, with a spare one per site."""
    gpus: int
    memory_gb: float
    cost: float
    """Cost of a robot for an hour."""

    @property
    def cores(self) -> int:
        """Return the number of cores of all routers and vision services."""
        return self.router_cores + self.services


def _column(text: str, title: str, row: str, column: str) -> str:
    """Return a cell of the comparison table of a section. Raises ValueError if it is missing."""
    section = text.partition(f"\n## {title}\n")[2].partition("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    for heads in (one for one in rows if column in one):
        for cells in (one for one in rows if one[0] == row and len(one) == len(heads)):
            return cells[heads.index(column)]
    raise ValueError(f"{PERFORMANCE}: no {column!r} of {row!r} in {title!r}")


def _number(pattern: str, text: str) -> float:
    match = re.search(pattern, text)
    if match is None:
        raise ValueError(f"{PERFORMANCE}: nothing fits {pattern!r}")
    return float(match[1])


def read_figures(docs: Path = DOCS) -> Figures:
    """Read the measured figures. Raises ValueError if one is missing."""
    text = (docs / PERFORMANCE).read_text("utf-8")
    loop = "The whole loop"
    router = json.loads((docs / ROUTER).read_text("utf-8"))
    return Figures(
        frame_bytes=float(_column(text, loop, "sightline", "bytes a picture")),
        vision_ms=_number(r"vision ([\d.]+)", _column(text, loop, "sightline", "CPU ms a picture")),
        hsv_ms=_number(r"\| hsv at 320x240, decoding included[^|]*\| ([\d.]+) \|", text) / 1e3,
        onnx_ms=_number(r"\| onnx at 320x240[^|]*from JPEG to boxes ([\d.]+),", text) / 1e3,
        memory_mb=_number(r"vision ([\d.]+)", _column(text, loop, "sightline", "memory MB")),
        router_us=float(router["cpu_us_a_frame"]),
        router_date=router["date"],
    )


def plan(robots: int, figures: Figures, given: Assumptions, extra_ms: float = 0.0, on_gpu: bool = False) -> Plan:
    """Compute the resources for `robots`.

    Args:
        extra_ms: CPU time of the detector for one frame, above that of the color detector.
        on_gpu: detectors run on GPUs.
    """
    frames_s = robots * given.fps
    mbit_s = frames_s * figures.frame_bytes * 8 / 1e6
    cores = frames_s * (figures.vision_ms + extra_ms) / 1e3 / given.busy
    sites = 0 if robots == 1 else math.ceil(mbit_s / (given.nic_gbit * 1e3 * given.busy))
    # When one router has failed, the other one has all sessions.
    while sites and math.ceil(robots / sites) + _services(cores, sites) / sites + SPARE_SESSIONS > MAX_SESSIONS:
        sites += 1
    # A frame crosses both routers when the robot and its vision service are at different ones, and one router carries
    # everything when the other one has failed.
    router_cores = 2 * sites * math.ceil(frames_s * figures.router_us / 1e6 / given.busy / max(sites, 1))
    services = _services(cores, sites)
    gpus = math.ceil(frames_s / (given.gpu_fps * given.busy)) if on_gpu else 0
    gigabytes = mbit_s / 8e3 * 3600
    price = (router_cores + services) * given.core_hour + gpus * given.gpu_hour + gigabytes * given.gigabyte
    return Plan(robots, frames_s, mbit_s, sites, router_cores, services, gpus, services * figures.memory_mb / 1e3,
                price / robots)


def _services(cores: float, sites: int) -> int:
    """Return the number of vision services: one per core, and a spare one per site, which may fail."""
    return sites * (math.ceil(cores / sites) + 1) if sites else math.ceil(cores)


def _rate(mbit_s: float) -> str:
    return f"{mbit_s:.0f} Mbit/s" if mbit_s < 1_000 else f"{mbit_s / 1e3:.1f} Gbit/s"


def table(plans: Sequence[Plan]) -> Iterator[str]:
    """Yield the lines of a table."""
    gpus = any(one.gpus for one in plans)
    heads = ["robots", "frames/s", "from the robots", "sites", "cores of routers", "vision services", "cores", "memory",
             *(["GPUs"] if gpus else []), "cost per robot-hour"]
    yield f"| {' | '.join(heads)} |"
    yield "|" + "---|" * len(heads)
    for one in plans:
        cells = [f"{one.robots:,}", f"{one.frames_s:,.0f}", _rate(one.mbit_s), f"{one.sites or 'none'}",
                 f"{one.router_cores}", f"{one.services:,}", f"{one.cores:,}", f"{one.memory_gb:.1f} GB",
                 *([f"{one.gpus}"] if gpus else []), f"{one.cost:.4f}"]
        yield f"| {' | '.join(cells)} |"


def lines(figures: Figures, given: Assumptions) -> Iterator[str]:
    """Yield the generated part of the page."""
    learned_ms = figures.onnx_ms - figures.hsv_ms
    yield "| input | value | source |"
    yield "|---|---|---|"
    loop = "[the whole loop](../reference/results/performance.md#the-whole-loop)"
    vision = "[vision](../reference/results/performance.md#vision)"
    yield f"| bytes of a 640x480 frame with header and answer | {figures.frame_bytes:,.0f} | measured: {loop} |"
    yield f"| CPU time of the vision service for it, color detector | {figures.vision_ms:.2f} ms | measured: {loop} |"
    yield f"| more for the learned detector on the CPU | {learned_ms:.2f} ms | measured: {vision} |"
    yield (f"| CPU time of a router for it | {figures.router_us:.0f} us | measured: "
           f"`python -m docs.make.scale --measure`, {figures.router_date}, next to other work |")
    yield f"| memory of a vision service | {figures.memory_mb:.0f} MB | measured: {loop} |"
    yield f"| frames per second of a robot | {given.fps:g} | chosen |"
    yield f"| planned load of cores and network cards | {given.busy * 100:g} % | chosen |"
    yield f"| network card of a router | {given.nic_gbit:g} Gbit/s | chosen |"
    yield f"| frames per second of a GPU | {given.gpu_fps:,.0f} | **assumed**, not measured |"
    prices = f"{given.core_hour:g} an hour, {given.gpu_hour:g} an hour, {given.gigabyte:g}"
    yield f"| price of a core, a GPU, a gigabyte | {prices} | **example**, not of a provider |"
    yield from ("", "Color detector on the CPU:", "")
    yield from table([plan(number, figures, given) for number in ROBOTS])
    yield from ("", "Learned detector on the CPU:", "")
    yield from table([plan(number, figures, given, extra_ms=learned_ms) for number in ROBOTS])
    yield from ("", "Learned detector on GPUs, in detector services, whose CPU time is not counted:", "")
    yield from table([plan(number, figures, given, on_gpu=True) for number in ROBOTS])


def page_text(page: str, figures: Figures, given: Assumptions) -> str:
    """Return the page with new tables. Raises ValueError if it lacks the marks."""
    text, count = MARKS.subn(lambda match: "\n".join([match[1], *lines(figures, given), "", match[2]]), page)
    if count != 1:
        raise ValueError(f"{PAGE}: expected one <!-- scale --> ... <!-- /scale -->")
    return text


# --- the cost of a frame for a router --------------------------------------------------------------------------------

FRAMES: Final = 1_000
PACE_S: Final = 0.01


def _cpu_s(pid: int) -> float:
    """Return the CPU time of a process and its living children."""
    total = 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            name, _, rest = stat.read_text().rpartition(") ")
        except OSError:
            continue
        values = rest.split()
        if int(name.split()[0]) == pid or int(values[1]) == pid:
            total += (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")
    return total


def measure_router(docs: Path = DOCS) -> float:
    """Send frames through a router to one vision service that answers each, and store the cost of one, in us."""
    from sightline.protocol.channels import ACK, FRAME
    from sightline.protocol.codec import encode
    from sightline.protocol.messages import FrameHeader
    from sightline.protocol.transports.link import Message
    from sightline.protocol.transports.open import open_link

    endpoint, payload, arrived = "tcp/127.0.0.1:7497", os.urandom(47_000), threading.Event()
    program = [*SIGHTLINE, "router", "--listen", endpoint]
    with subprocess.Popen(program, stdout=subprocess.DEVNULL) as router:
        try:
            with (open_link("r1", connect=[endpoint], role="robot", timeout_s=10.0) as robot,
                  open_link("r1", connect=[endpoint], role="vision", timeout_s=10.0) as vision):
                counts = {"frames": 0, "answers": 0}

                def answer(_message: Message) -> None:
                    counts["frames"] += 1
                    vision.publish(ACK, b'{"v": 1}', b"", "vision")

                def count(_message: Message) -> None:
                    counts["answers"] += 1
                    arrived.set()

                vision.subscribe(FRAME, answer)
                robot.subscribe(ACK, count)

                def send(seq: int) -> None:
                    robot.publish(FRAME, encode(FrameHeader(session="00000001", seq=seq, t_us=seq)), payload)
                    time.sleep(PACE_S)

                for seq in range(100):
                    send(seq)
                assert arrived.wait(5), "no answer crosses the router"
                before_s, before = _cpu_s(router.pid), counts["answers"]
                for seq in range(100, 100 + FRAMES):
                    send(seq)
                time.sleep(0.2)
                answered = counts["answers"] - before
                used_us = (_cpu_s(router.pid) - before_s) * 1e6 / answered
        finally:
            router.terminate()
    assert answered > 0.95 * FRAMES, f"{answered} of {FRAMES} frames were answered"
    machine = f"{processor()}, {os.cpu_count()} cores, {platform.system()} {platform.release()}"
    record = {"cpu_us_a_frame": round(used_us, 1), "frame_bytes": len(payload), "frames": answered,
              "frames_a_second": round(1 / PACE_S), "sessions": 2, "date": f"{datetime.now(UTC):%Y-%m-%d}",
              "machine": machine, "command": "python -m docs.make.scale --measure"}
    (docs / ROUTER).write_text(json.dumps(record, indent=2) + "\n", "utf-8")
    return used_us


def main(arguments: Sequence[str], docs: Path = DOCS) -> int:
    """Write the tables of docs/how-to/scale.md, print them, or measure a router."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--print", action="store_true", help="print the tables and write nothing")
    parser.add_argument("--measure", action="store_true", help="measure what a frame costs a router, then write")
    for field in fields(Assumptions):
        name = f"--{field.name.replace('_', '-')}"
        parser.add_argument(name, type=float, default=field.default, help=f"{HELP[field.name]} [%(default)s]")
    options = vars(parser.parse_args(arguments))
    only_print, measure = options.pop("print"), options.pop("measure")
    given = Assumptions(**options)
    wrong = [name for name, value in options.items() if not math.isfinite(value) or value < 0]
    wrong += [name for name in ("fps", "busy", "nic_gbit", "gpu_fps") if not options[name] > 0]
    if wrong or given.busy > 1:
        parser.error(f"invalid --{(wrong or ['busy'])[0].replace('_', '-')}: expected a positive number, busy up to 1")
    if given != Assumptions() and not only_print:
        parser.error("the page has the default values; add --print")
    if measure:
        print(f"a frame costs a router {measure_router(docs):.0f} us")
    if only_print:
        print("\n".join(lines(read_figures(docs), given)))
    else:
        page = docs / PAGE
        page.write_text(page_text(page.read_text("utf-8"), read_figures(docs), given), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
