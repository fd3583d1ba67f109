"""Every error that Sightline raises on purpose. Pure.

    SightlineError            one line for a person: what, where, how to fix it
     ├─ ConfigError   (2)     a bad option, file, environment variable or scenario
     ├─ HardwareError (3)     a device or the simulation is missing or broken
     ├─ LinkError     (4)     an endpoint cannot be opened or reached
     └─ WireError             bytes from a peer that are not the protocol; never ends a loop
"""

from sightline.protocol.refusals import RejectReason


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
