"""Writes systemd units for a robot or a vision service. Shell (files).

The units are readable files (`robot_side/systemd`, `vision_side/systemd`); only paths, user and pins change.
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
"""The pins in the file of `robot_side/systemd`: those of the example car."""


@dataclass(frozen=True)
class InstallPlan:
    """One systemd file: its path and text."""

    service: str
    path: Path
    text: str


def plan(service: str, program: Path, config: Path, user: str, unit_dir: Path = UNIT_DIR) -> InstallPlan:
    """Make the unit of `service` for this machine's paths.

    Raises:
        ConfigError: the service has no unit, or systemd cannot read the path or user.
    """
    if service not in SERVICES:
        raise ConfigError(f"unknown service '{service}'; expected {' or '.join(SERVICES)}")
    for what, text in (("program", str(program)), ("config", str(config)), ("user", user)):
        if not text or any(letter.isspace() or letter in "%\"'\\" for letter in text):
            raise ConfigError(f"invalid {what} '{text}' for a unit; remove spaces, quotes and %")
    name = f"sightline-{service}.service"
    unit = files(f"sightline.{service}_side").joinpath("systemd", name).read_text()
    unit = unit.replace("User=sightline", f"User={user}")
    return InstallPlan(service, unit_dir / name, _fitted(unit, service, program, config))


def drop_in(robot: RobotConfig, program: Path, config: Path, unit_dir: Path = UNIT_DIR) -> InstallPlan | None:
    """Make the file that sets the pins of a `gpio` drive low; None for another drive.

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


def _fitted(unit: str, service: str, program: Path, config: Path) -> str:
    """Insert this machine's paths and remove the comments, which describe the packaged file."""
    fitted = (
        unit.replace(_PROGRAM, str(program)).replace(_PYTHON, str(program.with_name("python")))
        .replace(f"/etc/sightline/{service}.toml", str(config))
        .replace("WorkingDirectory=-/etc/sightline", f"WorkingDirectory=-{config.parent}")
    )
    return "\n".join(line for line in fitted.splitlines() if line[:1] != "#") + "\n"


def write(planned: InstallPlan, beside: InstallPlan | None = None) -> None:
    """Write the unit and its second file, and start it now and at boot.

    A running service restarts: otherwise it may drive other pins than those that its end sets low.

    Raises:
        ConfigError: a file cannot be written, or systemd does not run; nothing is started.
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
        raise ConfigError(f"cannot write {planned.path}: {error.strerror}; run it with sudo") from None


def take_away(path: Path) -> bool:
    """Remove the second file of an earlier drive. Returns whether it existed. Raises ConfigError."""
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
        lines = (error.stderr or error.stdout).strip().splitlines()
        raise ConfigError(f"{' '.join(command)}: {lines[-1] if lines else 'failed'}") from None
