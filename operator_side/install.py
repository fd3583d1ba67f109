"""`sightline install`: a service that begins with the machine. Shell.

The units are files that a person can read (`robot_side/systemd`, `vision_side/systemd`); only paths and user change.
"""

import os
import subprocess
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from protocol.errors import ConfigError

SERVICES = ("robot", "vision")
UNIT_DIR = Path("/etc/systemd/system")
_PROGRAM = "/opt/sightline/bin/sightline"


@dataclass(frozen=True)
class Plan:
    """One unit file: where it goes and what it says."""

    service: str
    path: Path
    text: str


def plan(service: str, program: Path, config: Path, user: str, unit_dir: Path = UNIT_DIR) -> Plan:
    """The unit of `service`, for this machine's paths.

    Raises ConfigError for a service that has none, or for a path or user that systemd would misread.
    """
    if service not in SERVICES:
        raise ConfigError(f"service {service!r} has no unit: {' or '.join(SERVICES)}")
    for what, text in (("program", str(program)), ("config", str(config)), ("user", user)):
        if not text or any(letter.isspace() or letter in "%\"'\\" for letter in text):
            raise ConfigError(f"{what} {text!r} cannot stand in a unit: no spaces, quotes or %")
    name = f"sightline-{service}.service"
    unit = files(f"{service}_side").joinpath("systemd", name).read_text()
    fitted = (
        unit.replace(_PROGRAM, str(program))
        .replace(f"/etc/sightline/{service}.toml", str(config))
        .replace("User=sightline", f"User={user}")
    )
    return Plan(service, unit_dir / name, "\n".join(line for line in fitted.splitlines() if line[:1] != "#") + "\n")


def write(planned: Plan) -> None:
    """Put the unit in place and begin it, now and at every start of the machine.

    Raises ConfigError, with nothing begun, where it may not be written or systemd does not run.
    """
    try:
        planned.path.write_text(planned.text)
    except OSError as error:
        raise ConfigError(f"cannot write {planned.path}: {error.strerror}; try with sudo") from None
    for command in (["daemon-reload"], ["enable", "--now", planned.path.name]):
        _systemctl(command)


def _systemctl(arguments: list[str]) -> None:
    command = ["systemctl", *arguments]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, "SYSTEMD_COLORS": "0"})
    except FileNotFoundError:
        raise ConfigError("no systemd here; the unit is written, start the service by your own means") from None
    except subprocess.CalledProcessError as error:
        said = (error.stderr or error.stdout).strip().splitlines()
        raise ConfigError(f"{' '.join(command)}: {said[-1] if said else 'failed'}") from None
