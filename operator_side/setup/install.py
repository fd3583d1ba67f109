"""Writes systemd units for a robot or a vision service. Shell (files).

The units are files that a person can read (`robot_side/systemd`, `vision_side/systemd`); paths, user and pins change.
"""

import os
import subprocess
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.plugins import DRIVES

SERVICES = ("robot", "vision")
UNIT_DIR = Path("/etc/systemd/system")
_PROGRAM = "/opt/sightline/bin/sightline"
_PYTHON = "/opt/sightline/bin/python"
_DROP_IN = "gpio-low.conf"
_DROP_INS_PINS = "gpio_low 10 9 8 7 17"
"""As the file in `robot_side/systemd` has them: those of the example car."""


@dataclass(frozen=True)
class InstallPlan:
    """One file of systemd: where it goes and what it says."""

    service: str
    path: Path
    text: str


def plan(service: str, program: Path, config: Path, user: str, unit_dir: Path = UNIT_DIR) -> InstallPlan:
    """The unit of `service`, for this machine's paths.

    Raises ConfigError for a service that has none, or for a path or user that systemd would misread.
    """
    if service not in SERVICES:
        raise ConfigError(f"service {service!r} has no unit: {' or '.join(SERVICES)}")
    for what, text in (("program", str(program)), ("config", str(config)), ("user", user)):
        if not text or any(letter.isspace() or letter in "%\"'\\" for letter in text):
            raise ConfigError(f"{what} {text!r} cannot stand in a unit: no spaces, quotes or %")
    name = f"sightline-{service}.service"
    unit = files(f"sightline.{service}_side").joinpath("systemd", name).read_text()
    unit = unit.replace("User=sightline", f"User={user}")
    return InstallPlan(service, unit_dir / name, _fitted(unit, service, program, config))


def drop_in(robot: RobotConfig, program: Path, config: Path, unit_dir: Path = UNIT_DIR) -> InstallPlan | None:
    """What puts the pins of a robot whose drive is `gpio` low, beside its unit; None for another drive.

    Raises ConfigError where the drive's own options are wrong.
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
    """Where it lies, or lay."""
    return unit_dir / "sightline-robot.service.d" / _DROP_IN


def _fitted(unit: str, service: str, program: Path, config: Path) -> str:
    """With this machine's paths, and without the comments for who reads the file as it comes."""
    fitted = (
        unit.replace(_PROGRAM, str(program)).replace(_PYTHON, str(program.with_name("python")))
        .replace(f"/etc/sightline/{service}.toml", str(config))
        .replace("WorkingDirectory=-/etc/sightline", f"WorkingDirectory=-{config.parent}")
    )
    return "\n".join(line for line in fitted.splitlines() if line[:1] != "#") + "\n"


def write(planned: InstallPlan, beside: InstallPlan | None = None) -> None:
    """Put the unit in place, and what belongs beside it, and begin it, now and at every start of the machine. One that
    runs already begins anew: with other pins than those that are put low at its end it must not go on.

    Raises ConfigError, with nothing begun, where it may not be written or systemd does not run.
    """
    for one in [planned, *([beside] if beside else [])]:
        _put(one)
    for command in (["daemon-reload"], ["enable", planned.path.name], ["restart", planned.path.name]):
        _systemctl(command)


def _put(planned: InstallPlan) -> None:
    try:
        if planned.path.name == _DROP_IN:
            planned.path.parent.mkdir(exist_ok=True)
        planned.path.write_text(planned.text)
    except OSError as error:
        raise ConfigError(f"cannot write {planned.path}: {error.strerror}; try with sudo") from None


def take_away(path: Path) -> bool:
    """Remove what another drive left beside the unit; whether there was anything. Raises ConfigError."""
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigError(f"cannot remove {path}: {error.strerror}; try with sudo") from None
    return True


def _systemctl(arguments: list[str]) -> None:
    command = ["systemctl", *arguments]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, "SYSTEMD_COLORS": "0"})
    except FileNotFoundError:
        raise ConfigError("no systemd here; the unit is written, start the service by your own means") from None
    except subprocess.CalledProcessError as error:
        said = (error.stderr or error.stdout).strip().splitlines()
        raise ConfigError(f"{' '.join(command)}: {said[-1] if said else 'failed'}") from None
