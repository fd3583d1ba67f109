"""Required content of compose.yaml and the Dockerfile, without an engine; `test_containers.py` runs them."""

import ast
import itertools
import json
import re
import shutil
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor

import pytest
from packaging.requirements import Requirement
from typer.main import get_command

from sightline.operator_side.cli.commands import app
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.setup.keys import make
from sightline.protocol.channels import STATUS
from sightline.protocol.codec import encode
from sightline.protocol.messages import Status
from sightline.protocol.transports.security import load_role_keys
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.robot_side.driver.process import _SHUTDOWN_US
from sightline.robot_side.pipe import _END_S
from tests.e2e.compose.fixture import COMPOSE, DEFAULT, HEAVY, PROFILES, ROOT, SERVICES, ask, changed_for
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
ROBOTS = {service for profile in PROFILES for service, _ in profile.robots.values()}
PROGRAMS = {"detector", "legacy-client"}
"""Services that run an example, not `sightline`."""


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
    """Return the names of the packages that an extra installs, with this project's own extras followed."""
    found = set()
    for text in PROJECT["project"]["optional-dependencies"][extra]:
        wanted = Requirement(text)
        ours = wanted.name == PROJECT["project"]["name"]
        found |= {name for own in wanted.extras for name in requirements(own)} if ours else {wanted.name}
    return found


def extras_of(target: str) -> list[str]:
    """The extras that the image `target` installs."""
    assert ("COPY", f"--from={target}-packages /opt/sightline /opt/sightline") in STAGES[target]
    return re.search(r"\.whl\)\[([\w,]+)\]", str(STAGES[f"{target}-packages"]))[1].split(",")


def commands():
    """Every `sightline` command line in compose.yaml and the Dockerfile."""
    for name, service in SERVICES.items():
        if name not in PROGRAMS and "entrypoint" not in service:
            yield pytest.param(service["command"], id=name)
    for stage, lines in STAGES.items():
        if not any(word == "ENTRYPOINT" and "python" in rest for word, rest in lines):
            yield from (pytest.param(json.loads(rest), id=f"image {stage}") for word, rest in lines if word == "CMD")


@pytest.mark.parametrize("command", list(commands()))
def test_command_line_accepts_every_command(command):
    name, *arguments = command
    if name == "keys":
        return
    with get_command(app).commands[name].make_context(name, list(arguments)) as context:
        if name in ("sim", "robot", "vision"):
            given = {key: context.params.get(key) for key in ("robot", "listen", "connect", "secure", "socket_dir")}
            options = {key: value for key, value in given.items() if value and (name, key) != ("robot", "socket_dir")}
            load_service(name, profile=context.params.get("profile"), sets=context.params.get("sets") or (),
                         options=options, environ={})


CHECKS = {name: service["healthcheck"]["test"] for name, service in SERVICES.items() if "healthcheck" in service}
OF_A_KIND = {test[3]: name for name, test in reversed(CHECKS.items())}
"""Every program that is a health check, and the first service whose it is."""


@pytest.mark.parametrize("name", CHECKS)
def test_health_checks_use_the_link_of_the_service(name):
    command, program, minus_c, _, *arguments = CHECKS[name]
    assert (command, program, minus_c) == ("CMD", "python", "-c")
    assert "sightline." not in CHECKS[name][3], "its modules take CPU that the robots need"
    if name == "vision-shared":
        assert f"--metrics={arguments[0].removeprefix('http://').removesuffix('/ready')}" in SERVICES[name]["command"]
    elif not name.startswith("sim"):
        endpoint, keys, *asked = arguments
        robots = asked[1:]
        assert bool(keys) == endpoint.startswith("tls/") == name.startswith("secure")
        known = {robot for profile in PROFILES for robot in profile.robots if name in profile.services}
        assert set(robots) <= known and bool(robots) == ("router" not in name)


@pytest.mark.parametrize("name", OF_A_KIND.values())
def test_health_checks_fail_without_a_service_and_name_existing_targets(name, tmp_path):
    code, *arguments = CHECKS[name][3:]
    nowhere = free_endpoint()
    if name == "sim":
        arguments[0], why = str(tmp_path / "truth.sock"), "No such file"
    elif name == "vision-shared":
        arguments[0], why = nowhere.replace("tcp/", "http://") + "/ready", "Connection refused"
    else:
        arguments[0], why = nowhere, f"Unable to connect to any of [Single({nowhere})]"
    said = ask(sys.executable, "-c", code, *arguments)
    assert said.returncode == 1
    assert why in said.stderr


@pytest.mark.parametrize(("name", "grows", "why"), [
    ("robot", False, ""),
    ("vision", True, ""),
    ("vision", False, "no twists of r1"),
    ("detector", True, "no detections/* of r1"),
], ids=["status", "twists", "no twists", "no boxes"])
def test_health_checks_demand_what_the_service_publishes(name, grows, why):
    code, *arguments = CHECKS[name][3:]
    arguments[0] = endpoint = free_endpoint()
    with open_zenoh("r1", listen=[endpoint], role="robot") as robot, ThreadPoolExecutor() as beside:
        check = beside.submit(ask, sys.executable, "-c", code, *arguments)
        for count in itertools.count():
            robot.publish(STATUS, b"{}", encode(Status(state="HOLD", reason="", refused={"STALE": count * grows})))
            if until(check.done, 0.05):
                break
    assert check.result().returncode == (1 if why else 0), check.result().stderr
    assert why in check.result().stderr


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


# --- profiles ---------------------------------------------------------------------------------------------------------


def test_every_profile_has_a_test_and_one_is_the_default():
    assert {name for service in SERVICES.values() for name in service["profiles"]} == {one.name for one in PROFILES}
    assert f"COMPOSE_PROFILES={DEFAULT}" in (ROOT / ".env").read_text().splitlines()


@pytest.mark.parametrize("profile", PROFILES, ids=lambda profile: profile.name)
def test_profile_is_complete_and_opens_no_port_twice(profile):
    services = {name: SERVICES[name] for name in profile.services}
    for robot, (service, sim) in profile.robots.items():
        assert services[service]["depends_on"].keys() == {sim, profile.router, profile.second_router} - {""}
        assert ("--robot=" + robot in services[service]["command"]) == (robot != "r1")
    assert {profile.driver, profile.status, profile.router} <= set(services)
    ports = [port for service in services.values() for port in service.get("ports", ())]
    assert len(ports) == len(set(ports))
    for service in services.values():
        assert set(service.get("depends_on", ())) <= set(services), "depends on what this profile does not start"


def test_page_names_every_published_port_of_each_profile():
    page = (ROOT / "docs/how-to/containers.md").read_text("utf-8")
    named = dict(re.findall(r"^\| `([a-z-]+)` \| .* \| (7447[^|]*) \|$", page, re.MULTILINE))
    for profile in PROFILES:
        mappings = [port for name in profile.services for port in SERVICES[name].get("ports", ())]
        ports = [re.fullmatch(r"127\.0\.0\.1:(\d+):\d+(/udp)?", one).groups("") for one in mappings]
        assert named[profile.name].replace(", TLS", "").split(", ") == ["".join(one) for one in ports], profile.name
    assert all(f"127.0.0.1:{port}->{port}/{kind}" in page for port, kind in ((7447, "tcp"), (7448, "udp")))


def test_shared_profile_is_two_routers_that_every_service_names():
    profile = next(one for one in PROFILES if one.scale)
    both = [f"--connect=tcp/{router}:7447" for router in (profile.router, profile.second_router)]
    for name in set(profile.services) - {sim for _, sim in profile.robots.values()}:
        assert [word for word in SERVICES[name]["command"] if word.startswith("--connect")] == both, name
    scaled, number = profile.scale.split("=")
    assert scaled == profile.driver and int(number) == 3
    assert "--share" in SERVICES[scaled]["command"], "otherwise one of them drives and the others wait"
    assert not {"ports", "container_name", "hostname"} & SERVICES[scaled].keys(), "there are several of it"


def test_containers_of_a_test_publish_free_ports_only(tmp_path):
    ports = {"7447": "1", "7457": "2", "9091": "3"}
    services = changed_for(tmp_path, ports)["services"]
    for profile in PROFILES:
        opened = [port.split(":") for name in profile.services for port in services[name].get("ports", ())]
        numbers = [number for _, number, _ in opened]
        assert numbers and set(numbers) <= set(ports.values()) and len(numbers) == len(set(numbers))


def test_only_its_profile_serves_the_legacy_protocol():
    spoken = {name for name, service in SERVICES.items() if "ws-legacy" in str(service["command"])}
    assert spoken == {name for name, service in SERVICES.items() if "guests=true" in str(service)} == {"legacy-robot"}
    assert SERVICES["legacy-robot"]["profiles"] == ["legacy"]


def test_every_link_of_the_secure_profile_is_secured():
    for name in next(one for one in PROFILES if one.name == "secure").services:
        text = str(SERVICES[name])
        assert "tcp/" not in text and "ws" not in re.findall(r"\b(\w+)://", text), name
        assert name in ("sim", "keys") or ("--secure" in text and "tls/" in text), name
        own = {volume.split(":")[0] for volume in SERVICES[name].get("volumes", ()) if volume.startswith("keys-")}
        assert name == "keys" or "keys-site" not in own, f"{name} holds the authority's key"


@pytest.mark.parametrize("missing", ["*", "router.*", "stop.secret"], ids=["all", "router", "secret"])
def test_each_secured_service_finds_its_keys(missing, tmp_path):
    site = tmp_path / "site"
    (script,) = SERVICES["keys"]["command"]
    script = script.replace("$$", "$").replace("/keys/", f"{tmp_path}/").replace(
        "sightline keys", f"{sys.executable} -P -m sightline.operator_side.cli.app keys")
    for volume, where in mounts("keys").items():
        assert where == "/keys/" + volume.removeprefix("keys-")
        (tmp_path / volume.removeprefix("keys-")).mkdir()
    make(site, ["secure-router"])
    for file in site.glob(missing):
        file.unlink()
    assert ask("sh", "-euc", script).returncode == 0
    for name in next(one for one in PROFILES if one.name == "secure").services:
        found = re.search(r"--secure[ =](/keys/\w+)", " ".join(SERVICES[name]["command"]))
        if name not in ("keys", "sim"):
            role = {"status": "operator"}.get(name.removeprefix("secure-"), name.removeprefix("secure-"))
            assert found[1] in mounts(name).values()
            assert load_role_keys(found[1].replace("/keys", str(tmp_path)), role).role == role
            assert (tmp_path / role / "stop.secret").exists() == (role != "vision")


# --- what must hold for each ------------------------------------------------------------------------------------------


def test_each_service_with_a_health_check_is_queried():
    asks_others = {profile.status for profile in PROFILES} | {"status-r2", "status-r3", "keys", "legacy-client"}
    assert {name for name in SERVICES if "healthcheck" in SERVICES[name]} == set(SERVICES) - asks_others
    for name, service in SERVICES.items():
        # A vision service waits for its robot by itself; `depends_on` makes it end before the robot.
        follows = name in PROGRAMS or "vision" in name
        for other, wanted in service.get("depends_on", {}).items():
            once = "completed_successfully" if other == "keys" else "started" if follows else "healthy"
            assert wanted == {"condition": f"service_{once}"}
            assert once != "healthy" or "healthcheck" in SERVICES[other]


def test_the_robot_image_is_light_and_the_others_are_complete():
    assert not {name for extra in extras_of("robot") for name in requirements(extra)} & HEAVY
    assert {"zenoh", "websocket"} == set(extras_of("robot"))
    assert (extras_of("vision"), extras_of("sim")) == (["vision", "websocket", "metrics"], ["sim"])
    assert extras_of("keys") == ["secure"]


def test_images_have_every_package_and_copy_no_ignored_file():
    tree = ast.parse((ROOT / "setup.py").read_text())
    packages = {"sightline", *next(ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))}
    copied = {rest.split()[0] for word, rest in STAGES["wheel"] if word == "COPY"}
    assert copied == packages
    assert set(re.search(r"mkdir ([\w ]+?) +&&", str(STAGES["build"]))[1].split()) == packages
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    files, programs = ([name for word, rest in STAGES[stage] if word == "COPY" for name in rest.split()[:-1]]
                       for stage in ("build", "examples"))
    assert allowed == packages | set(files) | set(programs)
    assert {SERVICES[name]["command"][0] for name in PROGRAMS} == {file.rpartition("/")[2] for file in programs}
    assert all((ROOT / file).is_file() for file in files + programs)


def test_images_get_the_versions_of_the_lock(tmp_path):
    line = next(rest for _, rest in STAGES["build"] if "constraints.txt" in rest and "sed" in rest)
    shutil.copy(ROOT / "requirements.lock", tmp_path)
    subprocess.run(["sh", "-c", line], cwd=tmp_path, check=True)
    pins = [Requirement(one) for one in (tmp_path / "constraints.txt").read_text().splitlines()]
    locked = re.findall(r"^([\w.-]+)==", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    assert [pin.name for pin in pins] == locked
    assert all(str(pin.specifier).startswith("==") for pin in pins)


def mounts(name: str) -> dict[str, str]:
    """A service's volumes: volume -> where."""
    return dict(one.removesuffix(":ro").split(":") for one in SERVICES[name].get("volumes", ()))


def test_simulation_and_robot_share_private_sockets():
    pairs = {pair for profile in PROFILES for pair in profile.robots.values()}
    for robot, sim in pairs:
        shared = set(mounts(sim)) & set(mounts(robot))
        assert len(shared) == 1 and mounts(sim).keys() == shared
        (folder,) = {mounts(one)[volume] for one in (robot, sim) for volume in shared}
        for one in (robot, sim):
            assert re.search(rf"--socket-dir(=| ){folder}\b", " ".join(SERVICES[one]["command"])), one
        others = set(SERVICES) - {one for pair in pairs if shared & set(mounts(pair[0])) for one in pair}
        assert not any(shared & set(mounts(other)) for other in others)


def test_only_named_volumes_are_mounted_and_the_user_owns_them():
    made = re.search(r"install -d -m 0700 -o sightline -g sightline ([\w/ -]+)", str(STAGES["service"]))[1].split()
    for name in SERVICES:
        assert set(mounts(name)) <= set(COMPOSE["volumes"]), "a host's folder"
        assert set(mounts(name).values()) <= set(made)


def test_each_robot_stores_stop_on_a_separate_volume():
    state_dir = re.search(r"SIGHTLINE_ROBOT__STATE_DIR=([\w/]+)", str(STAGES["service"]))[1]
    for profile in PROFILES:
        kept = [volume for robot, _ in profile.robots.values() for volume in mounts(robot).items()]
        marks = [volume for volume, at in kept if at == state_dir]
        assert len(marks) == len(set(marks)) == len(profile.robots)


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_driver_is_not_killed_before_its_wheels_are_at_zero(name):
    assert float(SERVICES[name]["stop_grace_period"].removesuffix("s")) > _SHUTDOWN_US / 1e6 + _END_S
