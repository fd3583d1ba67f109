"""One robot at speed before a fault: its processes, network namespaces and logs. Shell."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, Self

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults import devices
from sightline.evaluation.faults.evidence import (
    GOOD,
    INJECTED,
    REQUESTED,
    ZERO_MS,
    MotorRow,
    SentCommand,
    measure_stop,
    read_events,
    read_motors,
    wheel_mps,
)
from sightline.evaluation.faults.peer import PeerOptions, Role
from sightline.evaluation.faults.sampler import Hole, read_holes, stalled_us
from sightline.evaluation.processes import Processes, free_port
from sightline.operator_side.config.toml_text import toml_text
from sightline.operator_side.setup import keys
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError, SightlineError
from sightline.robot_side.safety.limits import TICK_US
from sightline.sim.bus import SimDrive, SimSocketConfig
from sightline.sim.network_emulator import LinkShapes
from sightline.sim.tun_emulator import ADDRESS_A, namespaces

_RESIDENT: Final = "RssAnon:"


def memory_kib(processes: Processes, names: Iterable[str]) -> dict[tuple[str, str], int]:
    """Return the private memory of each running process and its children. A restarted child counts as the same."""
    which = {"itself": processes.pid, "driver": processes.driver, "network": processes.network, "stop": processes.stop}
    pids = {(name, role): pid_of(name) for name in names if name in processes.names for role, pid_of in which.items()}
    return {who: held for who, pid in pids.items() if pid and (held := _resident_kib(pid)) is not None}


def _resident_kib(pid: int) -> int | None:
    try:
        lines = Path(f"/proc/{pid}/status").read_text("ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) for line in lines if line.startswith(_RESIDENT)), None)


def raise_priority(pid: int) -> bool:
    """Set real-time scheduling for every thread of a process. Returns True if it was permitted."""
    try:
        for thread in Path(f"/proc/{pid}/task").iterdir():
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(1))
    except OSError:
        return False
    return True


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Run processes that use all available processor time."""
    busy = [subprocess.Popen([sys.executable, "-P", "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


# The bench's end of `sim/tun_emulator.py`: two namespaces and the wire between them, shaped while it runs. Shell.


_END_S: Final = 2.0
_PLAIN: Final = ("taken", "delivered", "delivered_bytes")


class BenchWire:
    """`ab` is from the robot, `ba` toward it. Use it as a context manager."""

    def __init__(self, log: Path) -> None:
        self.robot_side, self.far_side = (f"sightline-{os.getpid()}-{end}" for end in "ab")
        self._log = log
        self._ending = ExitStack()
        self._process: subprocess.Popen[str] | None = None
        self.counts: dict[str, Counter[str]] = {"ab": Counter(), "ba": Counter()}
        """The counters of each direction, up to the last `shape`."""

    def __enter__(self) -> Self:
        with self._ending:
            self._ending.enter_context(namespaces(self.robot_side, self.far_side))
            log = self._ending.enter_context(self._log.open("wb"))
            self._process = subprocess.Popen(
                [sys.executable, "-u", "-P", "-m", "sightline.sim.tun_emulator", self.robot_side, self.far_side],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, start_new_session=True,
            )
            self._ending.callback(self._end, self._process)
            if "ready" not in _file(self._process.stdout).readline():
                raise HardwareError(f"the wire does not start; see {self._log}")
            self._ending = self._ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def shape(self, shapes: LinkShapes) -> int:
        """Apply `shapes`. Returns how many packets the wire has harmed so far."""
        assert self._process is not None
        stdin = _file(self._process.stdin)
        stdin.write(shapes.model_dump_json() + "\n")
        stdin.flush()
        self.counts = {leg: Counter(count) for leg, count in json.loads(_file(self._process.stdout).readline()).items()}
        return sum(count for leg in self.counts.values() for name, count in leg.items() if name not in _PLAIN)

    @staticmethod
    def _end(process: subprocess.Popen[str]) -> None:
        _file(process.stdin).close()
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _file(pipe: IO[str] | None) -> IO[str]:
    assert pipe is not None
    return pipe


# A wrong wall clock in every Python process with this folder on its path. Shell (files).


def write_wrong_clock(folder: Path, offset_s: str) -> None:
    """Write a `sitecustomize` that adds the Python expression `offset_s` to `time.time` and logs one event."""
    (folder / "sitecustomize.py").write_text(
        f"""import time
right, right_ns = time.time, time.time_ns
time.time = lambda: right() + ({offset_s})
time.time_ns = lambda: right_ns() + int(({offset_s}) * 1e9)
with open({str(folder / "clock.events")!r}, "a") as log:
    log.write(f"{INJECTED},{{time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000}},0\\n")
""",
        "utf-8",
    )


ASLEEP: Final = "asleep"
"""While this file exists, the robot's clock that counts suspend is a minute ahead."""


def write_sleeping_clock(folder: Path) -> None:
    """Write a `sitecustomize` whose robot clock leaps as after a suspend, when the file ASLEEP appears."""
    (folder / "sitecustomize.py").write_text(
        f"""import os, time
right_ns = time.clock_gettime_ns
def clock_gettime_ns(clock):
    leaps = clock == time.CLOCK_BOOTTIME and os.path.exists({str(folder / ASLEEP)!r})
    return right_ns(clock) + (60_000_000_000 if leaps else 0)
time.clock_gettime_ns = clock_gettime_ns
""",
        "utf-8",
    )


# One robot at speed before a fault: simulation, robot and driver, each a process. Shell.


ROBOT: Final = "r1"
AT_SPEED_S: Final = 25.0
SESSION: Final = "5eed5eed"
STEADY_US: Final = 500_000
PORT: Final = 7447
_POLL_S: Final = 0.01
_TAIL_BYTES: Final = 8192
"""More than a second of the motors' log."""
_PROBED_S: Final = 0.5
_OPERATOR_READY_S: Final = 30.0
STOP_ENDS_S: Final = 20.0
KEPT_MPS: Final = 0.4
"""A scripted driver sends 0.5 m/s. A slower robot lost commands."""
_CHASE: Final[dict[str, Any]] = {
    "summary": "a ball on a circle at 0.4 m/s", "stand_off_m": 0.8, "look": "plain",
    "target": {"kind": "path", "speed_mps": 0.4, "path": [{"length_m": 12.566371, "turn_deg": 360.0}]},
    "start": {"distance_m": [0.8, 0.9], "bearing_deg": [-5.0, 5.0], "approach_deg": [170.0, 190.0]},
}
_EMPTY: Final[dict[str, Any]] = {
    "summary": "an empty floor", "look": "plain", "target": {"kind": "static"},
    "start": {"distance_m": [30.0, 30.0], "bearing_deg": [180.0, 180.0], "approach_deg": [0.0, 0.0]},
}


@dataclass(frozen=True, slots=True)
class Setup:
    """The driver and its link. `fault` is the fault of the driving peer after the trigger."""

    driver: Role = "driver"
    fault: str = ""
    wired: bool = False
    clock: str = ""
    """Python expression that is added to the wall clock of vision and robot, in seconds; "" leaves it."""
    sleeps: bool = False
    """The robot's clock leaps as after a suspend once `RobotFixture.suspend` is called."""
    camera: str = ""
    """Camera mode from the beginning."""
    source: str = "vision"
    """The role that a scripted driver takes."""
    linear_mps: float = 0.5
    """The speed that a scripted driver sends."""
    secure: bool = False
    """The links have keys, and the driver has the session `SESSION`, which an attacker knows."""
    web: bool = False
    """The robot also listens for WebSocket clients."""
    legacy: str | None = None
    """Replaces the robot by a legacy one, with this text format in its address. `fault` names its library."""
    guests: bool = False
    """It also accepts legacy clients, in place of WebSocket ones."""
    share: str = ""
    """Name in the token of the first driver; "" without one."""
    routed: bool = False
    """The robot connects to a router, and all others connect only to that router."""

    @property
    def at_speed_mps(self) -> float:
        """Return the speed before a fault. A guest has 0.2 m/s; vision follows a ball at 0.4."""
        return {"vision": 0.3, "guest": 0.18}.get(self.driver, 0.96 * self.linear_mps)

    @property
    def kept_mps(self) -> float:
        """Return the speed that the wheels keep until a fault or STOP."""
        return {"vision": 0.2, "guest": 0.15}.get(self.driver, KEPT_MPS)


def moving_stop(
    rows: Sequence[MotorRow], at_us: int, kept_mps: float, since: str = "the first packet", zero_ms: float = ZERO_MS,
) -> Iterable[Check]:
    """Check that the wheels turned at the first packet of a STOP, and the time until they stood."""
    speed_mps = next((wheel_mps(row) for row in reversed(rows) if row.t_us <= at_us), 0.0)
    yield at_least(f"speed at {since}", speed_mps, "m/s", kept_mps)
    yield at_most(f"zero after {since}", measure_stop(rows, at_us).zero_ms, "ms", zero_ms)


class RobotFixture:
    """A context manager. Inside, everything runs and the wheels are at speed."""

    def __init__(self, folder: Path, setup: Setup) -> None:
        self.folder, self.setup = folder, setup
        self._ending = ExitStack()
        self.processes = Processes(folder)
        self.wire: BenchWire | None = None
        self.endpoint = self.web_endpoint = ""
        self._peers: list[str] = []
        self._before_kib: dict[tuple[str, str], int] = {}
        self._sockets = ""

    def __enter__(self) -> Self:
        with self._ending:
            self._start()
            self._ending = self._ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def _start(self) -> None:
        self.folder.mkdir(parents=True)
        self._ending.enter_context(self.processes)
        self._sockets = self.processes.temporary_folder()
        if self.setup.wired:
            self.wire = self._ending.enter_context(BenchWire(self.folder / "wire.log"))
        transport = "tls" if self.setup.secure else "tcp"
        self.endpoint = f"tcp/{ADDRESS_A}:{PORT}" if self.wire else f"{transport}/127.0.0.1:{free_port()}"
        if self.setup.secure:
            keys.make(self.folder / "keys", ["127.0.0.1"])
        is_legacy = self.setup.legacy is not None
        if self.setup.web or self.setup.guests or is_legacy:
            web = "ws" if self.setup.web else "ws-legacy"
            self.web_endpoint = f"{web}://127.0.0.1:{free_port()}{self.setup.legacy or ''}"
        self._write_files(self._sockets)
        self.processes.start("sim", ["sim", "--config", str(self.folder / "sim.toml")])
        self.processes.start("sampler", [str(self.folder / "holes.csv")], module="sightline.evaluation.faults.sampler")
        self.processes.wait_line("sim", "simulation ready")
        self.processes.wait_line("sampler", "sampling")
        for name in ("sim", "sampler"):
            raise_priority(self.processes.pid(name))
        if self.setup.routed:
            secure = ["--secure", self.keys] if self.keys else []
            self.processes.start("router", ["router", "--listen", self.endpoint, *secure])
            self.processes.wait_line("router", "router: on")
        if is_legacy:
            self._start_legacy()
        else:
            self._start_own()
        self.wait_speed(self.setup.at_speed_mps)
        self._before_kib = memory_kib(self.processes, self._measured)

    def _start_legacy(self) -> None:
        """Start a legacy robot, and vision by the line of the README. Its address is the only option."""
        self.start_peer("robot", "legacy", fault=self.setup.fault, sockets=self._sockets)
        self.processes.wait_line("robot", f"robot {ROBOT}: on")
        self.processes.start("vision", ["vision", "--robot", self.web_endpoint, "--listen", self.endpoint])

    def _start_own(self) -> None:
        self.start_robot()
        session = {"session": SESSION} if self.setup.secure else {}
        self.start_peer("peer", self.setup.driver, fault=self.setup.fault, source=self.setup.source,
                        linear_mps=self.setup.linear_mps, share=self.setup.share, **session)

    def _write_files(self, sockets: str) -> None:
        device = {"kind": "sim", "options": {"socket_dir": sockets}}
        faulty_camera = {"kind": "sightline.evaluation.faults.devices:FaultyCamera",
               "options": {"socket_dir": sockets, "folder": str(self.folder)}}
        devices.write_spares(self.folder)
        self.camera_mode(self.setup.camera)
        wheels = {"kind": "sightline.evaluation.faults.devices:FaultyDrive", "options": faulty_camera["options"]}
        files: dict[str, dict[str, Any]] = {
            "scenario": _CHASE if self.setup.driver == "vision" else _EMPTY,
            "sim": {"scenario": str(self.folder / "scenario.toml"), "socket_dir": sockets, "seed": 1,
                    "motor_log": str(self.folder / "motors.csv")},
            "robot": {"robot": ROBOT, "state_dir": str(self.folder / "state"), "camera": faulty_camera, "drive": wheels,
                      "range_sensor": device, "safety": {"auto_arm": True, "guests": self.setup.guests},
                      "listen": []},
            "vision": {"robot": ROBOT},
        }
        for name, table in files.items():
            (self.folder / f"{name}.toml").write_text(toml_text(table), "utf-8")
        if self.setup.clock:
            write_wrong_clock(self.folder, self.setup.clock)
        if self.setup.sleeps:
            write_sleeping_clock(self.folder)

    # --- processes -----------------------------------------------------------------------------------------------

    def start_robot(self) -> None:
        """Start the robot and wait until it listens."""
        side = "--connect" if self.setup.routed else "--listen"
        arguments = ["robot", "--config", str(self.folder / "robot.toml"), side, self.endpoint]
        arguments += ["--listen", self.web_endpoint] if self.web_endpoint else []
        arguments += ["--secure", self.keys] if self.keys else []
        self.processes.start("robot", arguments, namespace=self.wire.robot_side if self.wire else "",
                             environment=self._environment(self.setup.sleeps))
        self.processes.wait_line("robot", f"robot {ROBOT}: on")

    @property
    def keys(self) -> str:
        """Return the folder of keys, or "" without them."""
        return str(self.folder / "keys") if self.setup.secure else ""

    def start_peer(self, name: str, role: Role, **changes: Any) -> None:
        """Start a vision service, a scripted driver or an operator."""
        options = PeerOptions(
            role=role, endpoint=self.endpoint, web_endpoint=self.web_endpoint, event_log=self.folder / f"{name}.events",
            config=self.folder / "vision.toml" if role == "vision" else None, secure=self.keys, **changes,
        )
        self._peers.append(name)
        self.processes.start(name, [options.model_dump_json()], module="sightline.evaluation.faults.peer",
                             namespace=self.wire.far_side if self.wire else "", environment=self._environment())

    def prepare_operator(self, **changes: Any) -> None:
        """Start a new operator, which waits to send STOP."""
        self.start_peer("operator", "stop", **changes)
        self.processes.wait_line("operator", "stop ready", _OPERATOR_READY_S)

    def stop_by_operator(self, *, moving: bool) -> tuple[int, tuple[Check, ...]]:
        """Let the new operator send STOP. Returns the time of its first packet, and the checks of the stop.

        Only a robot that is `moving` shows how soon its wheels reach zero.
        """
        self.trigger("operator")
        code = self.processes.exit_code("operator", STOP_ENDS_S)
        at_us = self.noted("operator", REQUESTED)[0].t_us
        self.watch(ZERO_MS / 1000)
        ended = at_most("exit code of stop", code, "", 0)
        return at_us, (*(moving_stop(self.motors(), at_us, self.setup.kept_mps) if moving else ()), ended)

    def start_load(self, kind: str, endpoint: str = "") -> None:
        """Start many clients, by default over WebSocket. Their events are those of a peer called `crowd`."""
        arguments = [kind, endpoint or self.web_endpoint, str(self.folder / "crowd.events")]
        self.processes.start("crowd", arguments, module="sightline.evaluation.faults.load_clients")

    def _environment(self, sleeps: bool = False) -> dict[str, str]:
        return {"PYTHONPATH": str(self.folder)} if self.setup.clock or sleeps else {}

    def suspend(self) -> int:
        """Let the robot's clock leap by a minute. Returns the time of the leap."""
        at_us = monotonic_us()
        (self.folder / ASLEEP).touch()
        return at_us

    def trigger(self, name: str = "peer") -> int:
        """Start a peer's fault. Returns its time."""
        at_us = monotonic_us()
        self.processes.signal(name, signal.SIGUSR1)
        return at_us

    def camera_mode(self, mode: str) -> int:
        """Set the mode of the camera from the next image on. Returns the time of the change."""
        at_us, new = monotonic_us(), self.folder / "camera.new"
        new.write_text(mode, "ascii")
        new.replace(self.folder / devices.MODE)
        return at_us

    def fail_drive(self, method: str) -> int:
        """Let a method of the drive raise from the next tick on. Returns the time of the change."""
        at_us = monotonic_us()
        (self.folder / devices.DRIVE_MODE).write_text(method, "ascii")
        return at_us

    def signal_network(self, number: signal.Signals) -> int:
        """Send a signal to the robot's network process. Returns its time."""
        at_us = monotonic_us()
        os.kill(self.processes.network("robot"), number)
        return at_us

    # --- waiting -------------------------------------------------------------------------------------------------

    def watch(self, seconds: float) -> None:
        """Let the processes run for this time."""
        time.sleep(seconds)

    def until(self, happened: Callable[[], bool], seconds: float, what: str) -> None:
        """Wait for a fact. Raises SightlineError with `what` after the time limit."""
        deadline_s = time.monotonic() + seconds
        while not happened():
            if time.monotonic() > deadline_s:
                raise SightlineError(f"fault bench: {what} did not happen within {seconds:g} s; see {self.folder}")
            time.sleep(_POLL_S)

    def wait_speed(self, mps: float, seconds: float = AT_SPEED_S) -> None:
        """Wait until the wheels have turned at `mps` or faster for half a second."""
        self.until(lambda: self._is_steady(mps), seconds, f"{mps} m/s")

    def _is_steady(self, mps: float) -> bool:
        late = [row for row in self._latest_motors() if row.t_us > monotonic_us() - STEADY_US]
        return len(late) > STEADY_US / 40_000 and all(wheel_mps(row) >= mps for row in late)

    def probe_motors(self) -> float:
        """Return the last set wheel speed after the end of the robot, m/s.

        It then sets zero, so that the log continues.
        """
        last_mps, end_s = wheel_mps(self.motors()[-1]), time.monotonic() + _PROBED_S
        while time.monotonic() < end_s:
            # A driver process that starts may own the motors for a moment.
            with suppress(HardwareError), closing(SimDrive(SimSocketConfig(socket_dir=self._sockets))) as drive:
                while time.monotonic() < end_s:
                    drive.set(0.0, 0.0)
                    drive.wheels()
                    time.sleep(TICK_US / 1e6)
            time.sleep(TICK_US / 1e6)
        return last_mps

    # --- evidence ------------------------------------------------------------------------------------------------

    def motors(self) -> list[MotorRow]:
        """Read the motor log so far."""
        path = self.folder / "motors.csv"
        return read_motors(path.read_text("ascii")) if path.exists() else []

    def _latest_motors(self) -> list[MotorRow]:
        """Read the end of the motor log, because a waiting case reads it often, and it grows."""
        path = self.folder / "motors.csv"
        if not path.exists():
            return []
        with path.open("rb") as log:
            log.seek(max(0, path.stat().st_size - _TAIL_BYTES))
            return read_motors(log.read().decode("ascii"))  # its first line, cut or a heading, is left out

    def sent(self, name: str | None = None) -> list[SentCommand]:
        """Return the good commands of one peer, or of all, oldest first."""
        names = self._peers if name is None else [name]
        return sorted((one for peer in names for one in self.noted(peer, GOOD)), key=lambda one: one.t_us)

    def noted(self, name: str, kind: str) -> list[SentCommand]:
        """Return the events of one kind from a peer, `camera` or `clock`."""
        return read_events(self.folder / f"{name}.events", kind)

    def injected(self, name: str = "peer") -> int:
        """Return the number of injected faults."""
        return len(self.noted(name, INJECTED))

    @property
    def _measured(self) -> tuple[str, ...]:
        """Return the processes of Sightline. The memory of a scripted driver that sends 10 MB does not count."""
        if self.setup.legacy is not None:  # its robot is a third-party server
            return ("sim", "vision")
        peer = ("peer",) if self.setup.driver in ("vision", "shared") else ()
        router = ("router",) if self.setup.routed else ()
        return ("sim", "robot", *peer, *router)

    def status(self) -> dict[str, Any]:
        """Return the output of `sightline status --json`."""
        self.processes.start("status", ["status", ROBOT, "--connect", self.endpoint, "--json"])
        self.processes.exit_code("status", AT_SPEED_S)
        printed = self.processes.log("status").read_text("utf-8")
        if not printed.startswith("{"):
            raise SightlineError(f"fault bench: no status: {printed.strip()}; see {self.folder}")
        status: dict[str, Any] = json.loads(printed)
        return status

    def logged(self, text: str) -> int:
        """Return the number of times that the log of the robot contains `text`."""
        return self.processes.log("robot").read_text("utf-8", "replace").count(text)

    def grown_mb(self) -> float:
        """Return the largest growth of a measured process since the wheels were at speed, in MB."""
        after_kib = memory_kib(self.processes, self._measured)
        grown_kib = (after_kib[who] - before for who, before in self._before_kib.items() if who in after_kib)
        return max(grown_kib, default=0) / 1024

    def stalled_us(self, from_us: int, to_us: int) -> int:
        """Return the longest time in the window without trustworthy stamps, us."""
        return stalled_us(self.holes(), from_us, to_us)

    def holes(self) -> list[Hole]:
        """Return when this machine stalled."""
        return read_holes(self.folder / "holes.csv")
