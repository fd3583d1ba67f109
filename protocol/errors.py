"""Reasons for rejecting a message, and every exception that Sightline raises on purpose. Pure, except `home_path` and
`install_command`, which read the home folders and the installation.
"""

from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


class RejectReason(StrEnum):
    """A reason why a robot rejects a message. The names are on the wire (status counters, replies)."""

    MALFORMED = "MALFORMED"  # invalid grammar, size, type or range of a header field
    UNSUPPORTED_VERSION = "UNSUPPORTED_VERSION"  # another version in header field `v`
    NOT_FINITE = "NOT_FINITE"  # nan, inf, or a number too large for a float
    UNKNOWN_SOURCE = "UNKNOWN_SOURCE"  # unknown role, key and header disagree, or guests are off
    OTHER_SESSION = "OTHER_SESSION"  # echoes a frame of an earlier robot session, or a STOP datagram of one
    UNKNOWN_FRAME = "UNKNOWN_FRAME"  # echoes a frame that this robot did not issue, or issued too long ago
    FROM_FUTURE = "FROM_FUTURE"  # echoes a capture time later than now
    STALE = "STALE"  # the frame behind it is too old
    OUT_OF_ORDER = "OUT_OF_ORDER"  # its `seq` is not newer than the last of that source and session
    NOT_PROVEN = "NOT_PROVEN"  # its `proof` does not continue that of the driver whose session it states
    NOT_HOLDER = "NOT_HOLDER"  # another driver holds the lease
    DISARMED = "DISARMED"  # valid, but the wheels are off
    STOPPED = "STOPPED"  # the STOP latch is set
    FAULT = "FAULT"  # the drive reports a fault
    NOT_ALLOWED = "NOT_ALLOWED"  # a request that this source must not send now
    OTHER_ROBOT = "OTHER_ROBOT"  # a STOP datagram for another robot
    WRONG_KEY = "WRONG_KEY"  # a STOP datagram without the HMAC of this robot's STOP secret


CLAMPED = "CLAMPED"
"""Counter next to the rejections: the command was accepted, and reduced to the robot's limits."""


# Every error that Sightline raises on purpose. Pure.
#
# SightlineError            one line for the operator: what, where, how to fix it
#  ├─ ConfigError   (2)     a bad option, file, environment variable or scenario
#  ├─ HardwareError (3)     a device or the simulation is missing or broken
#  ├─ LinkError     (4)     an endpoint cannot be opened or reached
#  ├─ CheckError    (5)     an evaluated run failed before it could be scored
#  └─ WireError             invalid bytes from a peer; never ends a loop


class SightlineError(Exception):
    """Base of all errors. The message is one line with a fix. A command exits with `exit_code`."""

    exit_code = 1


class ConfigError(SightlineError):
    """Bad usage or configuration."""

    exit_code = 2


class HardwareError(SightlineError):
    """A device, or the simulation in its place, is not usable."""

    exit_code = 3


class LinkError(SightlineError):
    """An endpoint cannot be opened or reached."""

    exit_code = 4


class CheckError(SightlineError):
    """An evaluated run failed before it could be scored."""

    exit_code = 5


class WireError(SightlineError):
    """A message from a peer was rejected.

    Args:
        reason: name of the counter.
        detail: one line about the cause.
    """

    def __init__(self, reason: RejectReason, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail


def home_path(path: "str | Path") -> "Path":
    """Return `path` with the home folder in place of a first `~` or `~USER`. Raises ConfigError for an unknown user."""
    from pathlib import Path  # here, because imports delay STOP

    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise ConfigError(f"no home folder for '{Path(path).parts[0]}' in {path}; write the whole path") from None


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation, from its clone or its wheel.

    Source: PEP 610, `direct_url.json`. The name on the index is not used, because nothing is published there.
    """
    import json  # here, because only errors need these, and imports delay STOP
    from importlib.metadata import PackageNotFoundError, distribution
    from pathlib import Path
    from urllib.parse import unquote, urlsplit

    try:
        origin = distribution("sightline-robot").read_text("direct_url.json")
    except PackageNotFoundError:
        origin = None
    record = json.loads(origin) if origin else {}
    if "vcs_info" in record:
        return f"pip install 'sightline-robot[{extra}] @ {record['vcs_info']['vcs']}+{record['url']}'"
    place = unquote(urlsplit(record["url"]).path) if record else "."
    # Without this option pip replaces an editable installation by a copy.
    editable = "--editable " if record.get("dir_info", {}).get("editable") else ""
    return f"pip install {editable}'{'.' if place == str(Path.cwd()) else place}[{extra}]'"
