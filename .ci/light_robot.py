"""Checks the robot side alone in a bare environment: what it installs, how it drives, how much memory it needs.

A new virtual environment gets `sightline-robot[zenoh]` and nothing else. In it runs the robot service, beside a
simulation and a vision service of this environment. Memory is the kernel's own high-water mark of each process.
    .venv/bin/python .ci/light_robot.py [SECONDS]
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sightline.evaluation.processes import children_of, driver_of
from sightline.protocol.channels import STATUS
from sightline.protocol.codec import decode
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import State, Status
from sightline.protocol.transports.link import LatestSlot, Message
from sightline.protocol.transports.zenoh.link import open_zenoh

ROOT: Final = Path(__file__).parent.parent
ENDPOINT: Final = "tcp/127.0.0.1:17461"
HEAVY: Final = ("numpy", "cv2", "pybullet", "simplejpeg", "matplotlib")
MEMORY_BOUND_MB: Final = 52.0
GUARDIAN_BOUND_MB: Final = 15.0
_START_S: Final = 30.0


@dataclass(frozen=True, slots=True)
class LightRobot:
    """Measured values. `driving_percent` is the share of statuses that were ACTIVE or DEGRADED."""

    heavy_packages: list[str]
    environment_mb: float
    fps: float
    driving_percent: float
    network_mb: float
    driver_mb: float
    guardian_mb: float
    """The larger one of guardian and STOP receiver."""


def measure_light_robot(seconds: float) -> LightRobot:
    """Install, drive for `seconds`, measure. Raises HardwareError if a process does not start."""
    with tempfile.TemporaryDirectory(prefix="sightline-light-") as name, ExitStack() as ending:
        folder = Path(name)
        python = _bare_environment(folder / "venv")
        os.sync()  # otherwise the disk is still writing the packages while the robot drives
        sockets = str(folder / "sockets")
        sim = ["sim", "--scenario", "circle", "--socket-dir", sockets]
        ending.enter_context(_service(sys.executable, sim, folder, "simulation ready"))
        state = f"state_dir={folder}"
        robot_arguments = ["robot", "--listen", ENDPOINT, "--socket-dir", sockets, "--set", state,
                           "--set", "safety.auto_arm=true"]
        robot = ending.enter_context(_service(python, robot_arguments, folder, "robot r1: on"))
        link = ending.enter_context(open_zenoh("r1", connect=[ENDPOINT], role="operator"))
        # `hsv`, because the default detector may need most of a slow machine. Then the robot would wait for answers.
        vision = ["vision", "--connect", ENDPOINT, "--detector", "hsv"]
        ending.enter_context(_service(sys.executable, vision, folder, "target seen"))
        fps, driving = _watch(link.latest(STATUS), seconds)
        driver = driver_of(robot.pid)
        network = children_of(driver)[-1]
        size = sum(path.stat().st_size for path in (folder / "venv").rglob("*") if path.is_file())
        guardian = max(map(_high_water_mb, {robot.pid, *children_of(robot.pid)} - {driver}))
        return LightRobot(
            _heavy(python), size / 1e6, fps, driving, _high_water_mb(network), _high_water_mb(driver), guardian
        )


def _bare_environment(folder: Path) -> str:
    venv.create(folder, with_pip=True)
    python = str(folder / "bin" / "python")
    pins = _pins(folder)
    elsewhere = folder / "build.cfg"  # what is left in a checkout would later be taken for its state
    elsewhere.write_text(f"[build]\nbuild_base = {folder / 'build'}\n[egg_info]\negg_base = {folder}\n")
    subprocess.run([python, "-m", "pip", "install", "--quiet", "-c", pins, f"{ROOT}[zenoh]"], check=True,
                   env=os.environ | {"DIST_EXTRA_CONFIG": str(elsewhere)})
    return python


def _pins(folder: Path) -> str:
    """The lock without its hashes, as constraints: the versions are pinned, what is installed is not."""
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    pins = folder / "constraints.txt"
    pins.write_text("\n".join(line.rstrip("\\ ") for line in lines if line[:1].isalnum()))
    return str(pins)


def _heavy(python: str) -> list[str]:
    code = "import importlib.util as u, sys; print(*[m for m in sys.argv[1:] if u.find_spec(m)])"
    found = subprocess.run([python, "-c", code, *HEAVY], capture_output=True, text=True, check=True, cwd="/")
    return found.stdout.split()


@contextmanager
def _service(python: str, arguments: list[str], folder: Path, ready: str) -> Iterator[subprocess.Popen[bytes]]:
    log = folder / f"{arguments[0]}.log"
    with log.open("wb") as out:
        # Not from the checkout, so that a bare environment finds nothing but what it has installed.
        command = [python, "-P", "-m", "sightline.operator_side.cli.app", *arguments]
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, cwd=folder)
    try:
        _wait_for(log, ready, process)
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(5)


def _wait_for(log: Path, text: str, process: subprocess.Popen[bytes]) -> None:
    deadline_s = time.monotonic() + _START_S
    while text not in log.read_text():
        if process.poll() is not None or time.monotonic() > deadline_s:
            raise HardwareError(f"{log.stem} did not start; it printed: {log.read_text().strip()}")
        time.sleep(0.05)


def _watch(statuses: LatestSlot[Message], seconds: float) -> tuple[float, float]:
    """(frames per second over the whole time, percent of statuses that drive)."""
    states: list[State] = []
    first = last = None
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        message = statuses.take(1.0)
        if message is not None:
            last = (time.monotonic(), decode(Status, message.payload, STATUS.max_payload_bytes))
            first = first or last
            states.append(last[1].state)
    if first is None or last is None or last is first:
        raise HardwareError("no status came from the robot")
    fps = (last[1].stream.sent - first[1].stream.sent) / (last[0] - first[0])
    return fps, 100 * sum(state in (State.ACTIVE, State.DEGRADED) for state in states) / len(states)


def _high_water_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def main() -> int:
    """Print each figure beside its bound. Returns the number of those that are not reached."""
    seen = measure_light_robot(float(sys.argv[1]) if len(sys.argv) > 1 else 20.0)
    figures = (
        ("heavy packages installed", len(seen.heavy_packages), 0),
        ("frames/s missing from 30", 30 - seen.fps, 0.6),
        ("% of the time not driving", 100 - seen.driving_percent, 2.0),
        ("MB, network process", seen.network_mb, MEMORY_BOUND_MB),
        ("MB, driver process", seen.driver_mb, MEMORY_BOUND_MB),
        ("MB, guardian or STOP receiver", seen.guardian_mb, GUARDIAN_BOUND_MB),
    )
    for name, value, bound in figures:
        print(f"light robot: {name}: {value:.3g} (at most {bound:g}){'' if value <= bound else ' NOT REACHED'}")
    return sum(value > bound for _, value, bound in figures)


if __name__ == "__main__":
    sys.exit(main())
