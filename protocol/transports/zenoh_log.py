"""What Zenoh turns away at a TLS endpoint, said by the service that listens there. Shell (a pipe, a thread).

Zenoh writes its log to the process's standard output and nowhere else. So that descriptor is given a pipe, the
service's own lines keep the real one, and whatever is not Zenoh's goes on as it came.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from protocol.log_lines import JsonLines
from protocol.transports.endpoints import check_endpoint
from protocol.transports.tcp_table import Visitors
from protocol.transports.tls_refusals import LOG_FILTER, RefusalLines, refusal_cause

_STDOUT = 1
_LOOKS_S = 0.6  # Zenoh does not say who it was; who is refused tries again within this, or is in the kernel's table


@contextmanager
def refusals_told(listen: Sequence[str], secure: str, say: Callable[[str], None]) -> Iterator[None]:
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
        zenoh.init_log_from_env_or(LOG_FILTER)
        told = _Told(doors, say)
        threading.Thread(target=told.read, args=(read_end,), name="zenoh-log", daemon=True).start()
        yield


class _Told:
    """Reads the log line by line."""

    def __init__(self, doors: Sequence[str], say: Callable[[str], None]) -> None:
        self._doors, self._say = doors, say
        self._visitors = Visitors({check_endpoint(door)[2] for door in doors})
        self._lines = RefusalLines()

    def read(self, read_end: int) -> None:
        """Until the pipe ends."""
        with os.fdopen(read_end, encoding="utf-8", errors="replace") as log, suppress(OSError, ValueError):
            for line in log:
                self._line(line)

    def _line(self, line: str) -> None:
        cause = refusal_cause(line)
        if cause is None:
            print(line, end="", flush=True)
            return
        times = self._lines.is_due(cause, time.monotonic_ns() // 1000) if cause else 0
        if times:
            often = f" ({times} times)" if times > 1 else ""
            who = self._visitors.who_left(_LOOKS_S)
            from_whom = f" from {who}" if who else ""
            self._say(f"refused a connection{from_whom} at {', '.join(self._doors)}{often}: {cause}")


@contextmanager
def _own_stdout() -> Iterator[int]:
    """A pipe in place of the standard output, which our own `print` keeps; gives the pipe's end to read from."""
    sys.stdout.flush()
    before, kept = sys.stdout, os.dup(_STDOUT)
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)  # a reader that is late costs lines of a log, never the link
    os.dup2(write_end, _STDOUT)
    os.close(write_end)
    ours = open(kept, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115
    sys.stdout = before.over(ours) if isinstance(before, JsonLines) else ours
    try:
        yield read_end
    finally:
        sys.stdout.flush()
        sys.stdout = before
        os.dup2(kept, _STDOUT)
        os.close(kept)
