"""Writes systemd units for a robot, a vision service or several of them. Shell (files).

The templates are readable files (`robot_side/systemd`, `vision_side/systemd`). Only paths, user and pins are replaced.
"""

import grp
import os
import pwd
import re
import subprocess
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from sightline.protocol import NAME_PATTERN
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.plugins import DRIVES

SERVICES = ("robot", "vision")
UNIT_DIR = Path("/etc/systemd/system")
_PROGRAM = "/opt/sightline/bin/sightline"
_PYTHON = "/opt/sightline/bin/python"
_DROP_IN = "gpio-low.conf"
MAX_INSTANCES = 64
"""Limit of vision services on one machine. More than one per core has no benefit."""
_STARTED_AT_BOOT = "multi-user.target.wants"
_DROP_INS_PINS = "gpio_low 10 9 8 7 17"
"""Pins in the file of `robot_side/systemd`: those of the example car."""
_GROUPS = "SupplementaryGroups=video gpio"
_STATE_DIR = "Environment=SIGHTLINE_ROBOT__STATE_DIR=/var/lib/sightline"
_NAME = " --name %l-%i"


@dataclass(frozen=True)
class InstallPlan:
    """One systemd file: its path and text, and the units to start (several for a template)."""

    service: str
    path: Path
    text: str
    units: tuple[str, ...] = ()


def plan(
    service: str, program: Path, config: Path, user: str, unit_dir: Path = UNIT_DIR, *, instances: int | None = None
) -> InstallPlan:
    """Create the unit of `service` for this machine, with its paths, groups and name.

    Args:
        instances: number of vision services that share the robots; None for a service that does not share.

    Raises:
        ConfigError: the service has no unit, or systemd cannot read the path or user.
    """
    if service not in SERVICES:
        raise ConfigError(f"unknown service '{service}'; expected {' or '.join(SERVICES)}")
    if instances is not None and service != "vision":
        raise ConfigError(f"--instances is for vision, and {service} runs once on a machine; remove it")
    if instances is not None and not 1 <= instances <= MAX_INSTANCES:
        raise ConfigError(f"invalid --instances {instances}: expected 1 to {MAX_INSTANCES}")
    for what, text in (("program", str(program)), ("config", str(config)), ("user", user)):
        if not text or any(letter.isspace() or letter in "$%\"'\\" for letter in text):
            raise ConfigError(f"invalid {what} '{text}' for a unit; remove spaces, quotes, $ and %")
    name = f"sightline-{service}{'' if instances is None else '@'}.service"
    units = (name,) if instances is None else tuple(name.replace("@", f"@{k}") for k in range(1, instances + 1))
    unit = files(f"sightline.{service}_side").joinpath("systemd", name).read_text()
    unit = unit.replace("User=sightline", f"User={user}").replace(_GROUPS, _present(_GROUPS))
    if not re.fullmatch(NAME_PATTERN, f"{os.uname().nodename.partition('.')[0]}-{MAX_INSTANCES}"):
        unit = unit.replace(_NAME, "")  # the service chooses its own name
    return InstallPlan(service, unit_dir / name, _fitted(unit, service, program, config), units)


def check_user(user: str, program: Path, config: Path) -> None:
    """Check that the account exists, and under sudo that it may use the files. Otherwise the service would not start.

    Raises:
        ConfigError: the account does not exist, or may not use a file.
    """
    try:
        account = pwd.getpwuid(int(user)) if user.isdigit() else pwd.getpwnam(user)
    except (KeyError, ValueError, OverflowError):
        raise ConfigError(f"unknown user '{user}'; create the account or name another one with --user") from None
    for test, path in (("-x", program), ("-x", program.with_name("python")), ("-r", config)):
        if os.geteuid() == 0 and not _permits(account, test, path):
            what = "execute" if test == "-x" else "read"
            raise ConfigError(f"user '{user}' may not {what} {path}; name another account with --user, or move it, "
                              f"e.g. to {'/opt/sightline' if test == '-x' else '/etc/sightline'}")


def _permits(account: pwd.struct_passwd, test: str, path: Path) -> bool:
    """Return whether test(1), run by the account, passes."""
    groups = os.getgrouplist(account.pw_name, account.pw_gid)
    return not subprocess.run(
        ["test", test, path], user=account.pw_uid, group=account.pw_gid, extra_groups=groups, cwd="/", check=False
    ).returncode


def with_state_in(planned: InstallPlan, folder: Path) -> InstallPlan:
    """Let the service store the STOP latch in the folder of its configuration, instead of the unit's folder.

    Raises:
        ConfigError: systemd cannot read the path, or it depends on the user.
    """
    if not folder.is_absolute() or any(letter.isspace() or letter in "%\"'\\" for letter in str(folder)):
        raise ConfigError(f"invalid state_dir '{folder}' for a unit; write a whole path, e.g. /var/lib/sightline, "
                          "without spaces, quotes and %")
    return replace(planned, text=planned.text.replace(_STATE_DIR, f"ReadWritePaths={folder}"))


def drop_in(robot: RobotConfig, program: Path, config: Path, unit_dir: Path = UNIT_DIR) -> InstallPlan | None:
    """Create the file that sets the pins of a `gpio` drive low; None for another drive.

    Raises:
        ConfigError: the options of the drive are invalid.
    """
    if robot.motors.kind != "gpio":
        return None
    _, options = DRIVES.load(robot.motors)
    pins = " ".join(str(number) for number in (*options.pins, *options.enable_pins))
    text = (
        files("sightline.robot_side")
        .joinpath("systemd", _DROP_IN)
        .read_text()
        .replace(_DROP_INS_PINS, f"gpio_low {pins}")
    )
    return InstallPlan("robot", drop_in_path(unit_dir), _fitted(text, "robot", program, config))


def drop_in_path(unit_dir: Path = UNIT_DIR) -> Path:
    """Return the path of the second file."""
    return unit_dir / "sightline-robot.service.d" / _DROP_IN


def _present(groups: str) -> str:
    """Remove the groups that this machine lacks, because systemd starts no service with an unknown group."""
    there = {one.gr_name for one in grp.getgrall()}
    key, _, names = groups.partition("=")
    return f"{key}={' '.join(name for name in names.split() if name in there)}"


def _fitted(unit: str, service: str, program: Path, config: Path) -> str:
    """Insert this machine's paths, and remove the comments, which describe the template."""
    fitted = (
        unit.replace(_PROGRAM, str(program)).replace(_PYTHON, str(program.with_name("python")))
        .replace(f"/etc/sightline/{service}.toml", str(config))
        .replace("WorkingDirectory=-/etc/sightline", f"WorkingDirectory=-{config.parent}")
    )
    return "\n".join(line for line in fitted.splitlines() if line[:1] != "#") + "\n"


def write(planned: InstallPlan, beside: InstallPlan | None = None) -> list[str]:
    """Write the unit and its second file, and start it now and at boot. Returns the units that it ended.

    A running service restarts, because otherwise its end could set other pins low than those it drives. Several
    services restart one after another, so that the others drive the robots meanwhile. Surplus instances end.

    Raises:
        ConfigError: a file cannot be written, or systemd does not run; nothing is started.
    """
    for one in [planned, *([beside] if beside else [])]:
        _put(one)
    _systemctl(["daemon-reload"])
    ended = _other_units(planned)
    if ended:
        _systemctl(["disable", "--now", *ended])
    _systemctl(["enable", *planned.units])
    for unit in planned.units:
        _systemctl(["restart", unit])
    return ended


def _other_units(planned: InstallPlan) -> list[str]:
    """Return the units of this service that start at boot and are not part of the plan."""
    of_service = re.compile(rf"sightline-{planned.service}(@[0-9]+)?\.service")
    at_boot = planned.path.parent / _STARTED_AT_BOOT
    names = [path.name for path in at_boot.glob(f"sightline-{planned.service}*")]
    return sorted(name for name in names if of_service.fullmatch(name) and name not in planned.units)


def _put(planned: InstallPlan) -> None:
    part = planned.path.with_name(f".{planned.path.name}.part")  # a full disk must not leave half a unit
    try:
        if planned.path.name == _DROP_IN:
            planned.path.parent.mkdir(exist_ok=True)
        part.write_text(planned.text)
        part.replace(planned.path)
    except OSError as error:
        with suppress(OSError):
            part.unlink()
        raise ConfigError(f"cannot write {planned.path}: {error.strerror}; run it with sudo") from None


def take_away(path: Path) -> bool:
    """Remove the second file of an earlier drive. Returns True if it existed. Raises ConfigError."""
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigError(f"cannot remove {path}: {error.strerror}; run it with sudo") from None
    return True


def _systemctl(arguments: list[str]) -> None:
    command = ["systemctl", *arguments]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, "SYSTEMD_COLORS": "0"})
    except FileNotFoundError:
        raise ConfigError("systemd is missing; the unit is written, start the service in another way") from None
    except subprocess.CalledProcessError as error:
        cause = " ".join((error.stderr or error.stdout).split())
        raise ConfigError(f"{' '.join(command)}: {cause or 'failed'}") from None
