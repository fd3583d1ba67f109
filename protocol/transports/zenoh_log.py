"""What Zenoh turns away at a TLS endpoint, and behind it, said by the service that listens there. Shell (a pipe).

Zenoh writes its log to the process's standard output and nowhere else. So that descriptor is given a pipe, the
service's own lines keep the real one, and whatever is not Zenoh's goes on as it came.
"""

from __future__ import annotations

import fcntl
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from sightline.protocol.clock import monotonic_us
from sightline.protocol.log import JsonLineStream, RepeatLimiter
from sightline.protocol.transports import denied
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint
from sightline.protocol.transports.tcp_table import Visitors
from sightline.protocol.transports.zenoh.access_log import TLS_LOG_FILTER, refusal_cause

_STDOUT = 1
_GULP_BYTES = 1_048_576  # what an unprivileged pipe can hold; one that is full costs lines
_GULP_S = 0.02
_LOOKS_S = 0.6  # Zenoh does not say who it was; who is refused tries again within this, or is in the kernel's table


@contextmanager
def log_rejected_peers(listen: Sequence[str], secure: str, say: Callable[[str], None]) -> Iterator[None]:
    """While inside, `say` who is turned away at the secured ones of `listen`, and why. Enter it before the link opens.

    For a process of its own: its standard output is redirected.
    """
    doors = [endpoint for endpoint in listen if endpoint.startswith(("tls/", "quic/"))]
    if not (secure and doors):
        yield
        return
    try:
        import zenoh
    except ImportError:  # whoever opens the link says so
        yield
        return
    with _own_stdout() as read_end:
        zenoh.init_log_from_env_or(f"{TLS_LOG_FILTER},{denied.ACCESS_LOG_FILTER}")
        told = _LogReader(doors, say)
        threading.Thread(target=told.read, args=(read_end,), name="zenoh-log", daemon=True).start()
        yield


class _LogReader:
    """Reads the log line by line."""

    def __init__(self, doors: Sequence[str], say: Callable[[str], None]) -> None:
        self._doors, self._say = doors, say
        self._visitors = Visitors({parse_zenoh_endpoint(door)[2] for door in doors})
        self._lines = RepeatLimiter()
        self._certificates = denied.Certificates()

    def read(self, read_end: int) -> None:
        """Until the pipe ends; in gulps, for whoever floods what it may not say causes a line each time."""
        rest = b""
        with os.fdopen(read_end, "rb", buffering=0) as log, suppress(OSError, ValueError):
            while gulp := log.read(_GULP_BYTES):
                *lines, rest = (rest[-_GULP_BYTES:] + gulp).split(b"\n")
                self._take(lines)
                time.sleep(_GULP_S)

    def _take(self, lines: list[bytes]) -> None:
        others = [line for line in lines if not line.endswith(denied.DENIED)]
        for line in others:
            self._line(line.decode("utf-8", "replace"))
        if len(others) < len(lines):
            self._tell_denied(len(lines) - len(others))

    def _line(self, line: str) -> None:
        if self._certificates.note(line):
            return
        cause = refusal_cause(line)
        if cause is None:
            print(line, flush=True)
            return
        often = self._often(cause, 1)
        if often is not None:
            who = self._visitors.who_left(_LOOKS_S)
            from_whom = f" from {who}" if who else ""
            self._say(f"refused a connection{from_whom} at {', '.join(self._doors)}{often}: {cause}")

    def _tell_denied(self, times: int) -> None:
        often = self._often(denied.WHY, times)
        if often is not None:
            who = self._certificates.connected(self._visitors.here())
            of_whom = f" of {who}" if who else ""
            self._say(f"refused a message{of_whom} at {', '.join(self._doors)}{often}: {denied.WHY}")

    def _often(self, cause: str, times: int) -> str | None:
        """How often since the last line about `cause`, in words; None if no line is due."""
        told = self._lines.is_due(cause, monotonic_us(), times) if cause else 0
        return None if not told else f" ({told} times)" if told > 1 else ""


@contextmanager
def _own_stdout() -> Iterator[int]:
    """A pipe in place of the standard output, which our own `print` keeps; gives the pipe's end to read from."""
    sys.stdout.flush()
    before, kept = sys.stdout, os.dup(_STDOUT)
    read_end, write_end = os.pipe()
    with suppress(OSError):
        fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, _GULP_BYTES)
    os.set_blocking(write_end, False)  # a reader that is late costs lines of a log, never the link
    os.dup2(write_end, _STDOUT)
    os.close(write_end)
    ours = open(kept, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115
    sys.stdout = before.over(ours) if isinstance(before, JsonLineStream) else ours
    try:
        yield read_end
    finally:
        sys.stdout.flush()
        sys.stdout = before
        os.dup2(kept, _STDOUT)
        os.close(kept)
