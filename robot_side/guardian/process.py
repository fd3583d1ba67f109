"""The guardian process: watches a driver process, kills it if it hangs, stops the wheels. Shell.

It loads only the standard library and `zero` of the drive, so that it is small and can hardly fail. It opens no device
while a driver process lives. A GPIO line has one owner, so the guardian kills the driver and waits for its end first.
"""

import ctypes
import json
import logging
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, Final

from sightline.protocol.clock import heartbeat_us
from sightline.protocol.log import start_log
from sightline.protocol.transports.stop_port import StopProcess
from sightline.robot_side.driver.supervision import (
    DRIVER_PRIORITY,
    EXIT_SIGNALS,
    GUARDIAN_PRIORITY,
    IGNORED_SIGNALS,
    SystemdNotifier,
    request_real_time,
    schedule_real_time,
)
from sightline.robot_side.guardian.core import (
    ENDING,
    ENDS_WITHIN_US,
    LATE_US,
    PERIOD_US,
    STARTS_WITHIN_US,
    WATCHED,
    HeartbeatMonitor,
    RestartBudget,
    exit_code_after,
    needs_zero,
    unpack_beat,
)
from sightline.robot_side.guardian.zero import load_zero

_log: Final = logging.getLogger("sightline.guardian")

_HARDWARE_EXIT: Final = 3
_SET_CHILD_SUBREAPER: Final = 36
_WATCHDOG_PERIOD_US: Final = 100_000
_ZERO_TRIES, _ZERO_RETRY_S, _ZERO_HANGS_S = 5, 0.1, 2.0
_BEATS_PER_LOOK: Final = 64
_ORPHANS_END_US: Final = 1_000_000
_NOT_COVERED: Final = (
    "not covered: if driver and guardian die together, or the kernel, the motors keep their last speed; fit the "
    "hardware cutoff of docs/how-to/hardware-cutoff.md{}"
)
_NO_WATCHDOG: Final = ", and run it under systemd, whose watchdog covers both processes (`sightline install robot`)"
_DRIVER: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); "
    "from sightline.robot_side.driver.process import main; main()"
)


class Guardian:
    """The guardian of one robot. `setup` is the data of `start.become_guardian`."""

    def __init__(self, setup: dict[str, Any]) -> None:
        self._setup = setup
        self._zero_config = setup["zero"]["config"]
        self._zero: Any = load_zero(setup["zero"])
        self._path = json.dumps(setup["path"])
        self._beats = socket.socket(fileno=setup["beats"])
        self._receiver: StopProcess | None = None
        ends = [self._beats]
        if setup["receiver"] is not None:
            near, far = (socket.socket(fileno=setup["receiver"][end]) for end in ("near", "far"))
            self._receiver = StopProcess(setup["receiver"]["module"], setup["receiver"]["options"], (near, far))
            ends += [near, far]
        for end in ends:
            end.set_inheritable(False)
        self._hang_up = _hang_up_of(self._beats)
        self._driver_pid: int = setup["pid"]
        self._status: int | None = None
        self._reason = ""
        """Why the driver process was killed, "" if it ended without being killed."""
        self._zero_failed: BaseException | None = None
        """Error of the last attempt to set the motors to zero, or None."""
        self._monitor = HeartbeatMonitor(heartbeat_us())
        self._budget = RestartBudget()
        self._end_signal: int | None = None
        self._end_by_us = 0
        self._fed_us = 0
        self._systemd = SystemdNotifier()
        for number in EXIT_SIGNALS:
            signal.signal(number, self._on_signal)
        for number in IGNORED_SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, EXIT_SIGNALS)

    def run(self) -> int:
        """Guard one driver process after the other. Returns the exit code of the robot; the wheels are at zero."""
        self._keep_receiver()
        self._send_ready()
        while True:
            code = os.waitstatus_to_exitcode(self._watch())
            if self._monitor.drive_failed:  # also if it ended before the guardian could kill it
                code = _HARDWARE_EXIT
            needs_zero_now = self._needs_zero(code)
            self._zero_failed = self._set_to_zero() if needs_zero_now else None
            self._log_end(code, was_zeroed=needs_zero_now)  # after zero: the log thread has no real-time priority
            self._kill_orphans()
            exit_code = exit_code_after(code, self._end_signal, was_running=self._monitor.is_running)
            if exit_code is not None:
                return exit_code
            motors = "the motors are at zero" if self._zero_failed is None else "the motors are NOT at zero"
            if self._setup["driver"] is None:
                return self._give_up(motors)
            if not self._budget.take(heartbeat_us()):
                return self._give_up(f"5 restarts within 60 s; {motors}; look for the cause above")
            self._start_driver()

    def _log_end(self, code: int, *, was_zeroed: bool) -> None:
        if self._reason:
            self._log_line(f"the driver process was killed: {self._reason}")
        elif code < 0:
            self._log_line(f"the driver process was ended by signal {-code}")
        elif self._monitor.is_running:
            self._log_line(f"the driver process ended by itself with code {code}; did a plug-in end it?")
        elif self._ended_at_start(code):
            self._log_line(f"the driver process ended before its first tick (code {code}), so the robot ends; see the "
                           "line above, or look for a plug-in that ends its process")
        if (error := self._zero_failed) is not None:
            _log.error("robot %s: motors NOT set to zero: %s: %s; switch off their supply",
                       self._setup["robot"], type(error).__name__, error, exc_info=error)
        elif was_zeroed:
            self._log_line("the motors are set to zero")

    def _ended_at_start(self, code: int) -> bool:
        """Return True for an end that no line explains. An error of the first start is printed by its command."""
        may_start = self._setup["driver"] is not None and self._end_signal is None
        return may_start and not self._monitor.is_ready and (code == 0 or self._fed_us > 0)

    def _needs_zero(self, code: int) -> bool:
        """Return True if the wheels may turn, also since an earlier process. An end with code 0 has stopped them."""
        is_needed = needs_zero(code, was_ready=self._monitor.is_ready, was_running=self._monitor.is_running)
        return is_needed or (self._zero_failed is not None and code != 0)

    def _give_up(self, why: str) -> int:
        _log.error("robot %s: the driver process is not started again: %s", self._setup["robot"], why)
        return _HARDWARE_EXIT

    # --- the driver process --------------------------------------------------------------------------------------

    def _watch(self) -> int:
        """Wait until the driver process has ended or was killed. Returns its wait status."""
        self._status, self._reason = None, ""
        while True:
            self._hang_up.poll((LATE_US if self._monitor.is_late else PERIOD_US) // 1000)
            now_us = heartbeat_us()
            is_open = self._read_beats(now_us)
            self._reap()
            if self._status is not None:
                return self._status
            run_us = run_us_of(self._driver_pid) if self._monitor.is_late else None
            self._reason = self._monitor.look(now_us, run_us)
            if self._monitor.is_late:
                hurry(self._driver_pid)
            if not self._reason and self._end_signal is not None and self._may_not_wait(now_us):
                self._reason = "did not end when requested" if self._monitor.is_ready else "ended before its start"
            if self._reason:
                os.kill(self._driver_pid, signal.SIGKILL)
                with without_real_time():
                    return os.waitpid(self._driver_pid, 0)[1]
            if self._monitor.is_starting:  # no heartbeat comes, and this process ends a start that hangs
                self._feed(now_us)
            if not is_open:
                time.sleep(0.001)
            self._keep_receiver()

    def _keep_receiver(self) -> None:
        if self._receiver is not None:
            self._receiver.keep_alive(heartbeat_us())

    def _send_ready(self) -> None:
        """Permit the driver process to move, because the guardian now detects its end."""
        with suppress(OSError):
            self._beats.send(WATCHED)

    def _read_beats(self, now_us: int) -> bool:
        """Read the heartbeats of the driver process. Returns False after the end of its socket."""
        for _ in range(_BEATS_PER_LOOK):
            try:
                packet = self._beats.recv(16)
            except BlockingIOError:
                return True
            except OSError:
                return False
            if not packet:
                return False
            self._on_beat(*unpack_beat(packet), now_us)
        return True

    def _on_beat(self, kind: bytes, sent_us: int, now_us: int) -> None:
        if not self._monitor.is_ready:
            self._permit_silence(os.environ.get("WATCHDOG_USEC", ""))
            # Logged once, after the lines of the driver's start. Without restarts an operator watches the process.
            if not self._fed_us and self._setup["driver"] is not None:
                self._log_line(_NOT_COVERED.format("" if self._systemd.is_active else _NO_WATCHDOG))
        self._monitor.on_beat(kind, sent_us)
        if kind == ENDING:
            self._systemd.notify("STOPPING=1")
        else:
            self._feed(now_us)

    def _feed(self, now_us: int) -> None:
        if now_us - self._fed_us >= _WATCHDOG_PERIOD_US:
            self._fed_us = now_us
            self._systemd.notify("READY=1\nWATCHDOG=1")

    def _permit_silence(self, watchdog_us: str | int) -> None:
        """Set the time of the systemd watchdog. It is longer while a new driver process starts."""
        if os.environ.get("WATCHDOG_USEC") and watchdog_us:
            self._systemd.notify(f"WATCHDOG_USEC={watchdog_us}")

    def _set_to_zero(self) -> BaseException | None:
        """Call `zero` of the drive, several times if a dying owner holds the device. Returns the error or None."""
        for _ in range(_ZERO_TRIES):
            failed: list[BaseException] = []
            calling = threading.Thread(target=self._call_zero, args=(failed,), name="zero", daemon=True)
            calling.start()
            calling.join(_ZERO_HANGS_S)
            if calling.is_alive():
                return TimeoutError(f"zero() does not return for {_ZERO_HANGS_S:g} s")
            if not failed:
                return None
            self._kill_orphans()
            time.sleep(_ZERO_RETRY_S)
        return failed[0]

    def _call_zero(self, failed: list[BaseException]) -> None:
        schedule_real_time(GUARDIAN_PRIORITY)
        try:
            self._zero(self._zero_config)
        except BaseException as error:  # third-party code; signals reach the main thread only
            failed.append(error)

    def _start_driver(self) -> None:
        self._permit_silence(STARTS_WITHIN_US)
        self._beats.close()
        self._beats, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._hang_up = _hang_up_of(self._beats)
        self._beats.send(self._setup["driver"].encode())
        self._send_ready()
        self._driver_pid = self._start([theirs, *([self._receiver.near] if self._receiver else [])])
        theirs.close()
        self._monitor = HeartbeatMonitor(heartbeat_us())
        self._log_line("a new driver process starts")

    def _start(self, ends: Sequence[socket.socket]) -> int:
        """Start a driver process whose arguments are the descriptors of `ends`. Returns its process id."""
        arguments = [sys.executable, "-P", "-c", _DRIVER, *(str(end.fileno()) for end in ends), self._path]
        for end in ends:
            end.set_inheritable(True)
        pid = os.posix_spawn(sys.executable, arguments, os.environ, setsigdef=IGNORED_SIGNALS, setsigmask=EXIT_SIGNALS)
        for end in ends:
            end.set_inheritable(False)
        return pid

    def _kill_orphans(self) -> None:
        """Kill the children of a dead driver process: its network process holds the port and the camera."""
        receiver = {self._receiver.pid} if self._receiver else set()
        by_us = heartbeat_us() + _ORPHANS_END_US
        while (orphans := set(_children()) - receiver) and heartbeat_us() < by_us:
            for pid in orphans:  # repeatedly, because children of a killed process become children of this one
                with suppress(OSError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.002)
            self._reap()

    def _reap(self) -> None:
        with suppress(ChildProcessError):
            # Check with real-time priority first. Without it, a driver process in an endless loop would block this one.
            while os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
                with without_real_time():
                    pid, status = os.waitpid(-1, os.WNOHANG)
                if pid == self._driver_pid:
                    self._status = status
                elif self._receiver is not None and pid == self._receiver.pid:
                    self._receiver.note_end(status)

    # --- the end -------------------------------------------------------------------------------------------------

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        """Forward a request to end. The driver process may have received it from the terminal, too."""
        if self._end_signal is None:
            self._end_signal, self._end_by_us = number, heartbeat_us() + ENDS_WITHIN_US
        if self._status is None:
            with suppress(ProcessLookupError):
                os.kill(self._driver_pid, number)

    def _may_not_wait(self, now_us: int) -> bool:
        return not self._monitor.is_ready or now_us >= self._end_by_us

    def _log_line(self, line: str) -> None:
        _log.info("robot %s: %s", self._setup["robot"], line)


@contextmanager
def without_real_time() -> Iterator[None]:
    """Reap a child without real-time priority.

    In `wait4`, Linux may spin until the last thread of the child has left `/proc`, which `run_us_of` reads. On a single
    processor this thread has a lower priority and would never run again.
    """
    is_real_time = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    if is_real_time:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    try:
        yield
    finally:
        if is_real_time:
            schedule_real_time(GUARDIAN_PRIORITY)


def _hang_up_of(beats: socket.socket) -> select.poll:
    """Return a poll object that reports the end of the other process, but not its heartbeats."""
    beats.setblocking(False)
    hang_up = select.poll()
    hang_up.register(beats, select.POLLRDHUP)
    return hang_up


def run_us_of(pid: int) -> int | None:
    """Return the processor time of `pid`, us, or None if none of its threads is ready to run.

    All threads count: the control loop may wait for the interpreter lock of another thread, which in turn waits for a
    processor.
    """
    is_ready, run_ns = False, 0
    try:
        for thread in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208  pathlib takes a megabyte
            is_ready |= _stat(f"{pid}/task/{thread}")[0] == "R"
            run_ns += int(_read(f"/proc/{pid}/task/{thread}/schedstat").split()[0])
    except (OSError, IndexError):  # the process is gone, or the kernel has no such statistics
        return None
    return run_ns // 1000 if is_ready else None


def hurry(pid: int) -> None:
    """Give all threads of `pid` the priority of the control loop, if that is permitted.

    Another process may open the devices of a killed process only after the end of its last thread. Threads without
    real-time priority may wait for a busy processor while the wheels turn.
    """
    with suppress(OSError):
        for thread in os.listdir(f"/proc/{pid}/task"):  # noqa: PTH208  pathlib takes a megabyte
            schedule_real_time(DRIVER_PRIORITY, int(thread))


def _children() -> list[int]:
    """Return the process ids of the children. Not every kernel lists them in one file."""
    own, found = str(os.getpid()), []
    for name in os.listdir("/proc"):  # noqa: PTH208  pathlib takes a megabyte
        with suppress(OSError):
            if name.isdigit() and _stat(name)[1] == own:
                found.append(int(name))
    return found


def _stat(pid: int | str) -> list[str]:
    """Return the fields of a process, from its state on."""
    return _read(f"/proc/{pid}/stat").rpartition(")")[2].split()


def _read(path: str) -> str:
    with open(path, encoding="ascii", errors="replace") as file:  # noqa: PTH123  pathlib takes a megabyte
        return file.read()


def main(setup: dict[str, Any]) -> None:
    """Run the guardian of `setup` and end with the exit code of its robot."""
    start_log(None, "robot")
    ctypes.CDLL(None).prctl(_SET_CHILD_SUBREAPER, 1, 0, 0, 0)  # children of a dead driver process come to this one
    try:
        guardian = Guardian(setup)
    except BaseException as error:  # third-party code; signals are blocked
        _log.error("robot %s: the guardian does not start: %s: %s", setup["robot"], type(error).__name__, error)
        sys.exit(1)
    for _ in request_real_time(GUARDIAN_PRIORITY):
        pass  # the driver process logs the missing permissions
    sys.exit(guardian.run())
