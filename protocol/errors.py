"""Reasons for rejecting a message, and every exception that Sightline raises on purpose. Pure."""

from enum import StrEnum


class RejectReason(StrEnum):
    """A reason a robot gives for not obeying. The names are on the wire (status counters, replies)."""

    MALFORMED = "MALFORMED"  # not the protocol: grammar, size, type, range of a header field
    UNSUPPORTED_VERSION = "UNSUPPORTED_VERSION"  # header `v` is not ours
    NOT_FINITE = "NOT_FINITE"  # nan, inf, or a number too large for a float
    UNKNOWN_SOURCE = "UNKNOWN_SOURCE"  # no such role, or key and header disagree, or guests are off
    OTHER_SESSION = "OTHER_SESSION"  # echoes a frame of an earlier robot session
    UNKNOWN_FRAME = "UNKNOWN_FRAME"  # echoes a frame this robot did not issue, or has forgotten
    FROM_FUTURE = "FROM_FUTURE"  # echoes a capture time later than now
    STALE = "STALE"  # the frame behind it is too old
    OUT_OF_ORDER = "OUT_OF_ORDER"  # its `seq` is not newer than the last of that source and session
    NOT_HOLDER = "NOT_HOLDER"  # another driver holds the lease
    DISARMED = "DISARMED"  # judged good, but the wheels are off
    STOPPED = "STOPPED"  # the STOP latch is set
    FAULT = "FAULT"  # the drive reports a fault
    NOT_ALLOWED = "NOT_ALLOWED"  # a request that this source may not make now


CLAMPED = "CLAMPED"
"""Counted beside the refusals: the command was accepted, but cut to the robot's limits."""


# Every error that Sightline raises on purpose. Pure.
#
# SightlineError            one line for a person: what, where, how to fix it
#  ├─ ConfigError   (2)     a bad option, file, environment variable or scenario
#  ├─ HardwareError (3)     a device or the simulation is missing or broken
#  ├─ LinkError     (4)     an endpoint cannot be opened or reached
#  └─ WireError             bytes from a peer that are not the protocol; never ends a loop


class SightlineError(Exception):
    """Base of all; the message is one line that a person can act on. `exit_code` is what a command exits with."""

    exit_code = 1


class ConfigError(SightlineError):
    """Bad usage or configuration."""

    exit_code = 2


class HardwareError(SightlineError):
    """A device, or the simulation that stands in for it, cannot be used."""

    exit_code = 3


class LinkError(SightlineError):
    """An endpoint cannot be listened on or reached."""

    exit_code = 4


class WireError(SightlineError):
    """Bytes from a peer were refused. `reason` is what is counted; the text says what was wrong."""

    def __init__(self, reason: RejectReason, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason
        self.detail = detail
