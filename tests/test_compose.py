"""compose.yaml and Dockerfile say what they must; and, asked for with `-m compose`, the containers run.

The real run needs an engine (`docker info` answers) and docker-compose or `docker compose`; docs/compose.md says how to
have one where no image can be pulled.
"""

import json
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from typer.main import get_command

from operator_side.cli import app
from operator_side.service_settings import load_service
from robot_side.child import _END_S
from robot_side.driver import _SHUTDOWN_US
from tests.link_rigs import free_endpoint, until

ROOT = Path(__file__).parent.parent
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
HEAVY = {"numpy", "opencv-python-headless", "pybullet", "simplejpeg", "matplotlib", "av"}


def stages() -> dict[str, list[tuple[str, str]]]:
    """The Dockerfile's stages: name -> its instructions, FROM included."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    found: dict[str, list[tuple[str, str]]] = {}
    for line in text.splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "FROM":
            image, _, name = rest.partition(" AS ")
            found[name] = [(word, image)]
        elif word and not word.startswith("#"):
            found[name].append((word, rest))
    return found


STAGES = stages()


def built_on(stage: str) -> list[tuple[str, str]]:
    """All instructions that make up an image, those of the stages below it first."""
    (_, image), *own = STAGES[stage]
    return [*(built_on(image) if image in STAGES else [("FROM", image)]), *own]


def requirements(extra: str) -> set[str]:
    """What an extra installs by name, extras of our own followed."""
    found = set()
    for text in PROJECT["project"]["optional-dependencies"][extra]:
        wanted = Requirement(text)
        ours = wanted.name == PROJECT["project"]["name"]
        found |= {name for own in wanted.extras for name in requirements(own)} if ours else {wanted.name}
    return found


def extra_of(target: str) -> str:
    """The extra that the image `target` installs."""
    assert ("COPY", f"--from={target}-packages /opt/sightline /opt/sightline") in STAGES[target]
    return re.search(r"\.whl\)\[(\w+)\]", str(STAGES[f"{target}-packages"]))[1]


def ask(*command: str, timeout_s: float = 20.0) -> subprocess.CompletedProcess[str]:
    """Run a command from the checkout, whatever its exit code."""
    return subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True, timeout=timeout_s)


def commands():
    """Every `sightline` command line in compose.yaml and the Dockerfile."""
    for name, service in SERVICES.items():
        yield pytest.param(service["command"], id=name)
        test = service.get("healthcheck", {}).get("test", [])
        if test[:2] == ["CMD", "sightline"]:
            yield pytest.param(test[2:], id=f"{name} health")
    for stage, lines in STAGES.items():
        yield from (pytest.param(json.loads(rest), id=f"image {stage}") for word, rest in lines if word == "CMD")


@pytest.mark.parametrize("command", list(commands()))
def test_every_command_is_one_the_command_line_takes(command):
    name, *arguments = command
    with get_command(app).commands[name].make_context(name, list(arguments)) as context:
        if name in ("sim", "robot", "vision"):
            given = {key: context.params.get(key) for key in ("listen", "connect", "socket_dir")}
            options = {key: value for key, value in given.items() if value and (name, key) != ("robot", "socket_dir")}
            load_service(name, profile=context.params.get("profile"), options=options, environ={})


def test_health_checks_in_python_fail_where_nothing_runs_and_name_what_exists(tmp_path):
    code = SERVICES["sim"]["healthcheck"]["test"][3].replace("/run/sightline", str(tmp_path))
    assert "nothing simulates a robot" in ask(sys.executable, "-c", code).stderr
    code = SERVICES["vision"]["healthcheck"]["test"][3].replace("tcp/robot:7447", free_endpoint())
    assert "nobody answers" in ask(sys.executable, "-c", code).stderr


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_is_confined(name):
    service = SERVICES[name]
    assert (service["init"], service["read_only"], service["cap_drop"]) == (True, True, ["ALL"])
    assert "no-new-privileges:true" in service["security_opt"]
    assert not {"privileged", "user", "network_mode", "pid", "cap_add", "devices"} & set(service)
    assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ()))


@pytest.mark.parametrize("name", SERVICES)
def test_every_image_has_a_target_and_runs_without_rights(name):
    target = SERVICES[name]["build"]["target"]
    assert SERVICES[name]["image"] == f"sightline-{target}"
    lines = built_on(target)
    assert [rest for word, rest in lines if word == "USER"][-1] == "sightline"
    assert lines[0] == ("FROM", "python:3.11-slim-bookworm")


def test_each_service_with_something_to_ask_is_asked():
    assert {name for name in SERVICES if "healthcheck" in SERVICES[name]} == {"sim", "robot", "vision"}
    for service in SERVICES.values():
        for other, wanted in service.get("depends_on", {}).items():
            assert wanted == {"condition": "service_healthy"}
            assert "healthcheck" in SERVICES[other]


def test_the_robot_image_is_light_and_the_others_are_complete():
    assert not requirements(extra_of("robot")) & HEAVY
    assert (extra_of("vision"), extra_of("sim")) == ("vision", "sim")


def test_images_hold_every_package_and_nothing_is_ignored_that_they_copy():
    packages = set(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
    copied = {rest.split()[0] for word, rest in STAGES["wheel"] if word == "COPY"}
    assert copied == packages
    assert set(re.search(r"mkdir ([\w ]+?) +&&", str(STAGES["build"]))[1].split()) == packages
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    files = next(rest.split()[:-1] for word, rest in STAGES["build"] if word == "COPY")
    assert allowed == packages | set(files)


def test_images_get_the_versions_of_the_lock(tmp_path):
    line = next(rest for _, rest in STAGES["build"] if "constraints.txt" in rest and "sed" in rest)
    shutil.copy(ROOT / "requirements.lock", tmp_path)
    subprocess.run(["sh", "-c", line], cwd=tmp_path, check=True)
    pins = [Requirement(one) for one in (tmp_path / "constraints.txt").read_text().splitlines()]
    locked = re.findall(r"^([\w.-]+)==", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert [pin.name for pin in pins] == locked
    assert all(str(pin.specifier).startswith("==") for pin in pins)


def test_simulation_and_robot_share_their_sockets_and_nothing_else():
    mounts = {name: dict(one.split(":") for one in SERVICES[name].get("volumes", ())) for name in SERVICES}
    for name in ("sim", "robot"):
        assert SERVICES[name]["command"][-2:] == ["--socket-dir", mounts[name]["hardware"]]
    assert set(mounts["sim"]) & set(mounts["robot"]) == {"hardware"}
    assert not mounts["vision"] | mounts["status"]
    assert all("/" not in volume for volumes in mounts.values() for volume in volumes), "a host's folder"


def test_the_stop_mark_is_kept_on_a_volume():
    state_dir = re.search(r"SIGHTLINE_ROBOT__STATE_DIR=([\w/]+)", str(STAGES["service"]))[1]
    assert f"robot-state:{state_dir}" in SERVICES["robot"]["volumes"]


def test_nobody_kills_a_driver_before_its_wheels_are_at_zero():
    assert float(SERVICES["robot"]["stop_grace_period"].removesuffix("s")) > _SHUTDOWN_US / 1e6 + _END_S


# --- the containers themselves ----------------------------------------------------------------------------------------

_TRUTH = """
from sim.bus import TruthReader
reader = TruthReader("/run/sightline")
for _ in range(250):
    truth = reader.read(1.0)
    print(truth.bearing_rad, truth.distance_m, truth.linear_mps)
"""


class Containers:
    """compose.yaml as it stands, but for a free port of this machine and the motors' log in `folder`."""

    def __init__(self, folder: Path):
        self.endpoint = free_endpoint()
        self.motor_log = folder / "log" / "motors.csv"
        self.motor_log.parent.mkdir()
        self.motor_log.parent.chmod(0o777)
        changed = yaml.safe_load((ROOT / "compose.yaml").read_text())
        services = changed["services"]
        services["robot"]["ports"] = [f"127.0.0.1:{self.endpoint.rpartition(':')[2]}:7447"]
        services["sim"]["environment"].append("SIGHTLINE_SIM__MOTOR_LOG=/log/motors.csv")
        services["sim"]["volumes"].append(f"{self.motor_log.parent}:/log")
        self._file = folder / "compose.yaml"
        self._file.write_text(yaml.safe_dump(changed))

    def compose(self, *arguments: str, check: bool = True) -> str:
        """Run docker-compose and return what it printed."""
        program = ["docker-compose"] if shutil.which("docker-compose") else ["docker", "compose"]
        where = ["-p", "sightline-test", "-f", str(self._file), "--project-directory", str(ROOT)]
        done = ask(*program, *where, *arguments, timeout_s=1200)
        assert done.returncode == 0 or not check, done.stderr[-3000:]
        return done.stdout

    def status(self) -> dict:
        """The robot's status, asked from outside through the published port; {} if it is not heard."""
        asked = ask(sys.executable, "-m", "operator_side.cli", "status", "--json", "--connect", self.endpoint)
        return json.loads(asked.stdout) if asked.returncode == 0 else {}

    def drives(self) -> bool:
        return until(lambda: self.status().get("state") in ("ACTIVE", "DEGRADED"), 30)

    def inside(self, service: str, *command: str) -> str:
        """What a command prints inside a service's container."""
        return self.compose("exec", "-T", service, *command)

    def speeds(self) -> list[tuple[float, float]]:
        """(left, right) rad/s, oldest first."""
        rows = [line.split(",") for line in self.motor_log.read_text().splitlines()[1:]]
        return [(float(row[1]), float(row[2])) for row in rows]


def engine_missing() -> str:
    """Why the containers cannot be run here; "" if they can."""
    if not shutil.which("docker"):
        return "docker is not installed"
    asked = ask("docker", "version", "--format", "{{.Server.Version}}")
    return "" if asked.returncode == 0 else f"no engine runs: {asked.stderr.strip()}"


@pytest.fixture(scope="module")
def containers(request, tmp_path_factory):
    if "compose" not in request.config.option.markexpr:
        pytest.skip("builds images for minutes; ask for it with: pytest -m compose")
    if reason := engine_missing():
        pytest.skip(reason)
    running = Containers(tmp_path_factory.mktemp("compose"))
    try:
        running.compose("up", "-d", "--build")
        yield running
    finally:
        running.compose("down", "--volumes", "--timeout", "4", check=False)


@pytest.mark.compose
def test_the_robot_in_containers_follows_the_ball(containers):
    assert containers.drives()
    time.sleep(6)  # acquired and up to the ball's speed
    lines = containers.inside("sim", "python", "-c", _TRUTH).splitlines()
    rows = [[float(word) for word in line.split()] for line in lines]
    assert len(rows) == 250  # five seconds
    assert max(abs(bearing_rad) for bearing_rad, _, _ in rows) < 0.1
    assert all(0.6 < distance_m < 1.0 for _, distance_m, _ in rows)
    assert sum(linear_mps > 0.05 for _, _, linear_mps in rows) > 200


@pytest.mark.compose
def test_every_container_says_that_it_is_well(containers):
    names = containers.compose("ps", "-q", "sim", "robot", "vision").split()
    assert len(names) == 3
    asked = ("docker", "inspect", "-f", "{{.State.Health.Status}}", *names)
    assert until(lambda: ask(*asked).stdout.split() == ["healthy"] * 3, 30), ask(*asked).stdout
    assert "state" in containers.compose("logs", "--no-color", "status")


@pytest.mark.compose
def test_containers_have_no_rights_and_the_robot_no_heavy_package(containers):
    for service in SERVICES:
        assert containers.inside(service, "id", "-u").strip() == "10001"
        assert "Read-only" in containers.inside(service, "sh", "-c", "touch /opt/x 2>&1 || true")
    listed = containers.inside("robot", "pip", "list", "--format", "json")
    assert not {package["name"].lower() for package in json.loads(listed)} & HEAVY


@pytest.mark.compose
def test_stop_outlives_the_container_until_reset_and_armed(containers):
    containers.inside("robot", "sightline", "stop")
    containers.compose("restart", "robot")
    assert until(lambda: containers.status().get("state") == "STOPPED", 20)
    containers.inside("robot", "sightline", "reset")
    containers.inside("robot", "sightline", "arm")
    assert containers.drives()


@pytest.mark.compose
def test_a_driving_robot_ends_within_two_seconds_with_zero_sent(containers):
    assert containers.drives()
    assert until(lambda: max(map(abs, containers.speeds()[-1])) > 1.0, 10)
    started_s = time.monotonic()
    containers.compose("stop", "robot")
    assert time.monotonic() - started_s < 2.0
    assert containers.speeds()[-1] == (0.0, 0.0)
    name = containers.compose("ps", "--all", "-q", "robot").strip()
    assert ask("docker", "inspect", "-f", "{{.State.ExitCode}}", name).stdout.strip() == "0"
