"""Content of compose.yaml and the Dockerfile, and the containers of one profile, run for real.

A real run needs an engine (`docker version` answers) and docker-compose or `docker compose`;
docs/how-to/containers.md shows how to get one where no image can be pulled.
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import yaml

from tests.fixtures.links import until
from tests.fixtures.ports import free_port

ROOT = Path(__file__).parent.parent.parent.parent
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
HEAVY = {"numpy", "opencv-python-headless", "pybullet", "simplejpeg", "matplotlib", "av"}
DEFAULT = "plain"
IMAGES = {service["image"]: name for name, service in reversed(SERVICES.items())}
"""Every image, and the first service that is made of it."""

# The images of a simulation that is behind the clock are old, so its robot must be slow or stand: those seconds do
# not count.
_TRUTH = """
from sightline.protocol.clock import monotonic_us
from sightline.sim.bus import TruthReader
reader, rows = TruthReader("/run/sightline"), []
for _ in range(3000):
    truth = reader.read(1.0)
    if monotonic_us() - truth.t_us > 100_000:
        rows.clear()
    rows.append((truth.bearing_rad, truth.distance_m, truth.linear_mps))
    if len(rows) == 400:
        break
for row in rows[150:400]:
    print(*row)
"""

_LATE = """
from sightline.protocol.clock import monotonic_us
from sightline.sim.bus import TruthReader
reader, until_us = TruthReader("/run/sightline"), monotonic_us() + 9_000_000
print("watches", flush=True)
while (now_us := monotonic_us()) < until_us:
    truth = reader.read(1.0)
    if truth is None or monotonic_us() - truth.t_us > 100_000:
        print(now_us, flush=True)
"""


@dataclass(frozen=True)
class Profile:
    """Promises of a profile: the service and simulation of each robot, and the service that drives them all."""

    name: str
    robots: dict[str, tuple[str, str]]
    driver: str
    status: str = "status"
    router: str = "router"
    max_bearing_rad: float = 0.1
    second_router: str = ""
    scale: str = ""
    """SERVICE=N, as `up --scale` takes it."""

    @property
    def services(self) -> list[str]:
        return [name for name, service in SERVICES.items() if self.name in service["profiles"]]


PROFILES = [
    Profile("plain", {"r1": ("robot", "sim")}, "vision"),
    Profile("remote-detector", {"r1": ("robot", "sim")}, "boxes-vision"),
    # Guests turn by at most 1 rad/s, and the older client steers by the ball's place alone.
    Profile("legacy", {"r1": ("legacy-robot", "sim")}, "legacy-client", "legacy-status", max_bearing_rad=0.25),
    Profile("secure", {"r1": ("secure-robot", "sim")}, "secure-vision", "secure-status", "secure-router"),
    Profile("fleet", {"r1": ("robot", "sim"), "r2": ("robot-r2", "sim-r2"), "r3": ("robot-r3", "sim-r3")},
            "fleet-vision"),
    Profile("shared", {"r1": ("shared-robot", "sim"), "r2": ("shared-robot-r2", "sim-r2"),
                       "r3": ("shared-robot-r3", "sim-r3")}, "vision-shared", "shared-status", "shared-router-a",
            second_router="shared-router-b", scale="vision-shared=3"),
]


def ask(*command: str, timeout_s: float = 30.0) -> subprocess.CompletedProcess[str]:
    """Run a command from the checkout, whatever its exit code."""
    return subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s)


def engine_missing() -> str:
    """Why the containers cannot be run here; "" if they can."""
    if not shutil.which("docker"):
        return "docker is not installed"
    asked = ask("docker", "version", "--format", "{{.Server.Version}}")
    return "" if asked.returncode == 0 else f"no engine runs: {asked.stderr.strip()}"


def changed_for(folder: Path, ports: dict[str, str]) -> dict:
    """Return compose.yaml with free ports of this machine, motor logs in `folder`, and builds that use the name servers
    of this machine."""
    changed = yaml.safe_load((ROOT / "compose.yaml").read_text())
    for name, service in changed["services"].items():
        service["build"]["network"] = "host"
        if "ports" in service:
            _, published, inside = service["ports"][0].split(":")
            service["ports"] = [f"127.0.0.1:{ports[published]}:{inside}"]
        if service["image"] == "sightline-sim":
            (log := folder / name).mkdir()
            log.chmod(0o777)
            # New lists: services that share an anchor share theirs.
            service["environment"] = [*service["environment"], "SIGHTLINE_SIM__MOTOR_LOG=/log/motors.csv"]
            service["volumes"] = [*service["volumes"], f"{log}:/log"]
    return changed


class Containers:
    """The containers of one profile: `up`, what they do, `down`."""

    def __init__(self, profile: Profile, folder: Path) -> None:
        self.profile = profile
        self.ports = {published: str(free_port()) for published in ("7447", "7457", "9091")}
        self._folder = folder
        self._project = f"sightline-test-{profile.name}"
        self._containers: dict[str, str] = {}
        self._file = folder / "compose.yaml"
        self._file.write_text(yaml.safe_dump(changed_for(folder, self.ports)))
        self.reached = ["--connect", f"tcp/127.0.0.1:{self.ports['7447']}"]

    def compose(self, *arguments: str, check: bool = True) -> str:
        """Run docker-compose for this profile and return what it printed."""
        program = ["docker-compose"] if shutil.which("docker-compose") else ["docker", "compose"]
        where = ["-p", self._project, "-f", str(self._file), "--project-directory", str(ROOT)]
        named = [] if self.profile.name == DEFAULT else ["--profile", self.profile.name]
        done = ask(*program, *where, *named, *arguments, timeout_s=1200)
        assert done.returncode == 0 or not check, done.stderr[-3000:]
        return done.stdout

    def up(self) -> None:
        """Start them. Where the profile is secured, also fetch the operator's keys for commands from outside."""
        scaled = ["--scale", self.profile.scale] if self.profile.scale else []
        self.compose("up", "-d", "--no-build", *scaled)
        if self.profile.name == "secure":
            ask("docker", "cp", f"{self.container('secure-status')}:/keys/operator", str(self._folder / "keys"))
            secure = ["--secure", str(self._folder / "keys")]
            self.reached = ["--connect", f"tls/127.0.0.1:{self.ports['7447']}", *secure]

    def down(self) -> None:
        """End and forget them."""
        self.compose("down", "--volumes", "--timeout", "4", check=False)

    def container(self, service: str) -> str:
        """A service's container, ended or not; it stays the same over restarts."""
        # One request to the engine lists all containers, because docker-compose takes seconds for each.
        if service not in self._containers:
            listed = ask("docker", "ps", "--all", "--filter", f"label=com.docker.compose.project={self._project}",
                         "--format", '{{.Label "com.docker.compose.service"}} {{.ID}}')
            self._containers = {line.split()[0]: line.split()[1] for line in listed.stdout.splitlines()}
        return self._containers[service]

    def inside(self, service: str, *command: str, timeout_s: float = 30.0) -> str:
        """Return the output of a command inside a service's container."""
        done = ask("docker", "exec", self.container(service), *command, timeout_s=timeout_s)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def sightline(self, command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command as an outside operator does, through the published port."""
        return ask(sys.executable, "-P", "-m", "sightline.operator_side.cli.app", command, *arguments, *self.reached)

    def state(self, robot: str) -> str:
        """Return a robot's state, or "" if no status is received."""
        asked = self.sightline("status", robot, "--json")
        return json.loads(asked.stdout)["state"] if asked.returncode == 0 else ""

    def drives(self, robot: str) -> bool:
        return until(lambda: self.state(robot) in ("ACTIVE", "DEGRADED"), 40)

    def truth(self, sim: str) -> list[list[float]]:
        """The world's own account: bearing, distance, the robot's speed in the last five of the first eight seconds
        in which the simulation keeps up with the clock. Waits a minute for them."""
        lines = self.inside(sim, "python", "-c", _TRUTH, timeout_s=90.0).splitlines()
        return [[float(word) for word in line.split()] for line in lines]

    def replicas(self, service: str) -> list[str]:
        """Return all containers of a service."""
        label = "label=com.docker.compose"
        filters = ("--filter", f"{label}.project={self._project}", "--filter", f"{label}.service={service}")
        return ask("docker", "ps", "--all", *filters, "--format", "{{.ID}}").stdout.split()

    def motor_rows(self, sim: str) -> list[tuple[float, float, float]]:
        """Return the motor commands as (time in us, left, right in rad/s), oldest first."""
        rows = [line.split(",") for line in (self._folder / sim / "motors.csv").read_text().splitlines()[1:]]
        return [(float(row[0]), float(row[1]), float(row[2])) for row in rows if len(row) >= 3]

    def speeds(self, sim: str) -> list[tuple[float, float]]:
        """Return the commanded motor speeds as (left, right) in rad/s, oldest first."""
        return [(left, right) for _, left, right in self.motor_rows(sim)]

    def stands(self, sim: str, first: int) -> list[tuple[float, float]]:
        """Return when a robot stood since motor command number `first`: from and to, us."""
        stands, began_us = [], None
        for t_us, left, right in self.motor_rows(sim)[first:]:
            if left or right:
                began_us = None
            elif began_us is None:
                began_us = t_us
                stands.append((t_us, t_us))
            else:
                stands[-1] = began_us, t_us
        return stands

    @contextmanager
    def lateness(self, sims: list[str]) -> Iterator[dict[str, list[float]]]:
        """Note for 9 s when each simulation is over 100 ms behind the clock, us."""
        late_us: dict[str, list[float]] = {sim: [] for sim in sims}
        watches = {sim: subprocess.Popen(["docker", "exec", self.container(sim), "python", "-c", _LATE], text=True,
                                         stdout=subprocess.PIPE) for sim in sims}
        for watch in watches.values():
            assert watch.stdout.readline() == "watches\n"
        yield late_us
        for sim, watch in watches.items():
            late_us[sim] += map(float, watch.communicate(timeout=20.0)[0].splitlines())

    def health(self) -> dict[str, str]:
        """Return the engine's health status of every service that has a health check."""
        names = [name for name in self.profile.services if "healthcheck" in SERVICES[name]]
        ask_each = ["docker", "inspect", "-f", "{{.State.Health.Status}}", *(self.container(name) for name in names)]
        return dict(zip(names, ask(*ask_each).stdout.split(), strict=False))
