"""Run cases in several parallel processes, each against a separate peer that the kit starts. Shell (processes)."""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from sightline.conformance.case import Case
from sightline.conformance.report import from_lines
from sightline.conformance.runner import Outcome, Result
from sightline.protocol.errors import ConfigError, LinkError

_KIT: Final = (sys.executable, "-P", "-m", "sightline.operator_side.cli.app", "conform")
_NO_PEER: Final = 4
"""Exit code of the kit before its peer answers."""
_START_S: Final = 60.0
_END_S: Final = 5.0
_POLL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class Jobs:
    """`start` is a command line with {endpoint}, and {job} for separate folders; `options` go to each kit."""

    side: str
    endpoint: str
    start: str
    count: int
    options: Sequence[str]

    def endpoint_of(self, job: int) -> str:
        """Return the endpoint of a job: the port of the first, counted up. Raises ConfigError without a port."""
        found = re.fullmatch(r"(.*:)(\d+)(/?)", self.endpoint)
        if found is None:
            raise ConfigError(f"invalid ENDPOINT '{self.endpoint}': --jobs counts its port up; add a port")
        return f"{found[1]}{int(found[2]) + job}{found[3]}"

    def command_of(self, job: int) -> list[str]:
        """Return the command of a peer. Raises ConfigError if it has no placeholder for the endpoint."""
        if "{endpoint}" not in self.start:
            raise ConfigError("--jobs needs --start COMMAND with {endpoint}, "
                              "e.g. --start 'sightline robot --listen {endpoint} --set state_dir=/tmp/state-{job}'")
        text = self.start.replace("{endpoint}", self.endpoint_of(job)).replace("{job}", str(job))
        return shlex.split(text)

    def run(self, cases: Sequence[Case], on_result: Callable[[Result], None]) -> list[Result]:
        """Run each case in one of the jobs. Raises ConfigError or LinkError for a peer that cannot be tested."""
        commands = [self.command_of(job) for job in range(self.count)]
        for job in range(self.count):
            _check_free(self.endpoint_of(job))
        lock = threading.Lock()

        def show(result: Result) -> None:
            with lock:
                on_result(result)

        shares = [cases[job :: self.count] for job in range(self.count)]
        with ThreadPoolExecutor(self.count, "conform-job") as pool:
            running = [pool.submit(self._run_one, job, commands[job], shares[job], show)
                       for job in range(self.count) if shares[job]]
            return [result for one in running for result in one.result()]

    def _run_one(
        self, job: int, command: list[str], cases: Sequence[Case], on_result: Callable[[Result], None]
    ) -> list[Result]:
        peer, last_error = _start(command)
        deadline_s = time.monotonic() + _START_S
        try:
            while True:
                code, results, reported = self._kit(job, cases, on_result)
                ended = peer.poll()
                if code != _NO_PEER or results or time.monotonic() > deadline_s or ended is not None:
                    break
        finally:
            _end(peer)
        if ended is not None and (ended or not results) and not any(one.outcome is Outcome.FAILED for one in results):
            raise LinkError(f"the peer of --start ended with exit code {ended}: {last_error()}; "
                            f"try its command: {shlex.join(command)}")
        if len(results) < len(cases):
            raise LinkError(f"job {job} ended after {len(results)} of {len(cases)} cases: {reported}")
        return results

    def _kit(
        self, job: int, cases: Sequence[Case], on_result: Callable[[Result], None]
    ) -> tuple[int, list[Result], str]:
        """Run one kit. Returns its exit code, its results, and the last line of its errors."""
        endpoint = self.endpoint_of(job)
        only = [part for case in cases for part in ("--only", case.id)]
        command = [*_KIT, self.side, endpoint, *only, *self.options, "--json-lines"]
        results: list[Result] = []
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as kit:
            assert kit.stdout is not None and kit.stderr is not None
            errors = kit.stderr
            reported: list[str] = []
            reader = threading.Thread(target=lambda: reported.extend(errors), name=f"conform-{job}", daemon=True)
            reader.start()
            for line in kit.stdout:
                for result in from_lines(line, cases, self.side, endpoint, f"of job {job}"):
                    results.append(result)
                    on_result(result)
            reader.join(_END_S)
        return kit.returncode, results, reported[-1].strip() if reported else "no message"


def _check_free(endpoint: str) -> None:
    """Raise ConfigError if the endpoint is in use: that server would be tested in place of the kit's peer."""
    host, _, port = endpoint.rstrip("/").rpartition("/")[2].rpartition(":")
    with suppress(OSError, ValueError, OverflowError):
        socket.create_connection((host.strip("[]"), int(port)), _END_S).close()
        raise ConfigError(f"something listens on {endpoint} already; end it, or leave out --start to test it")


def _start(command: list[str]) -> tuple[subprocess.Popen[str], Callable[[], str]]:
    """Return the peer, and a function that returns its last line of errors after its end. Raises ConfigError."""
    try:
        peer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                                errors="replace", start_new_session=True)
    except OSError as error:
        raise ConfigError(f"cannot start --start {command[0]!r}: {error.strerror}; is it installed?") from None
    errors, lines = peer.stderr, deque[str](maxlen=1)
    assert errors is not None
    reader = threading.Thread(target=lambda: lines.extend(filter(None, map(str.strip, errors))), name="conform-errors",
                              daemon=True)
    reader.start()

    def last_error() -> str:
        reader.join(_END_S)
        return lines[0] if lines else "no message"

    return peer, last_error


def _end(peer: subprocess.Popen[str]) -> None:
    """End the peer and each process that it started, first by a request."""
    deadline_s = time.monotonic() + _END_S
    with suppress(ProcessLookupError):
        os.killpg(peer.pid, signal.SIGTERM)
        while time.monotonic() < deadline_s:
            peer.poll()
            os.killpg(peer.pid, 0)
            time.sleep(_POLL_S)
        os.killpg(peer.pid, signal.SIGKILL)
    peer.wait()
