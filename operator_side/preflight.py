"""A package that is not installed, said as the command that installs it. Pure."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from sightline.protocol.errors import ConfigError

_OURS = ("protocol", "robot_side", "vision_side", "sim", "operator_side", "benchmarks")
_PYBULLET_UP_TO = (3, 11)


@contextmanager
def needs(extra: str, version: tuple[int, int] = sys.version_info[:2]) -> Iterator[None]:
    """Imports inside that fail become a ConfigError naming `sightline[extra]`; ours are faults and stay as they are."""
    try:
        yield
    except ImportError as error:
        package = (error.name or "").partition(".")[0]
        if not package or package in _OURS:
            raise
        raise ConfigError(_advice(package, extra, version)) from None


def _advice(package: str, extra: str, version: tuple[int, int]) -> str:
    if package == "pybullet" and version > _PYBULLET_UP_TO:
        return (
            f"PyBullet has no ready-made package for Python {version[0]}.{version[1]}: use Python 3.11, or "
            "`docker compose up`, or let pip compile it (minutes): pip install 'sightline[sim]'"
        )
    return f"{package} is not installed: pip install 'sightline[{extra}]'"
