"""Decide when a driver process counts as hung, and whether to start it again. Pure; standard library only.

A heartbeat is a byte and its time. The control loop sends one at each tick. Silence is measured in the driver's own
time, without the time that the driver waited for a processor, and without delays of the guardian itself.
"""

from collections import deque
from typing import Final

AT_REST: Final = b"0"
"""Heartbeat: the wheels are at zero."""
MOVING: Final = b"1"
"""Heartbeat: the wheels turn."""
LOST: Final = b"l"
"""Heartbeat: the wheels turn and the drive rejects speeds, so only the guardian can stop them."""
IDLE: Final = b"i"
"""The wheels are at zero, and the next heartbeat may wait for an operator."""
STARTING: Final = b"s"
"""The wheels are at zero, and the next heartbeat waits for the start of a child."""
WATCHED: Final = b"w"
"""Message of a guardian to a driver process that it watches from now on."""
ENDING: Final = b"e"
"""The last heartbeat: the wheels are at zero, and files and devices are being closed."""
FAILED: Final = b"f"
"""The last heartbeat: the drive rejected zero at the end, so only the guardian can stop the wheels."""

PERIOD_US: Final = 100_000
"""Time between two checks of a driver. Each check wakes the guardian. The end of a driver wakes it without a check."""
LATE_US: Final = 25_000
"""Silence of a late driver, and then the time between two checks. The loop sends a heartbeat within 20 ms."""
HUNG_US: Final = 200_000
"""Silence in the driver's own time after which it counts as hung."""
REJECTS_US: Final = 100_000
"""Time for which a drive rejects speeds until turning wheels count as out of control."""
STARVED_US: Final = 500_000
"""Silence of a driver without a processor, after which moving wheels are stopped. They are at zero within 700 ms."""
STARTS_WITHIN_US: Final = 30_000_000
"""Longest time to the first heartbeat, because a start reads its packages from a slow card; also after STARTING."""
ENDS_WITHIN_US: Final = 7_000_000
"""Longest end after a request: 2 s for the ramp, then latch, network process and battery, each within a second."""
MAX_RESTARTS: Final = 5
RESTART_WINDOW_US: Final = 60_000_000

_OUT_OF_CONTROL: Final = {
    LOST: "its drive took no speeds for 100 ms",
    FAILED: "its drive did not take zero at the end",
}
_LIMITS: Final = {
    b"": (STARTS_WITHIN_US, "did not start within 30 s"),
    STARTING: (STARTS_WITHIN_US, "did not start its network process within 30 s"),
    ENDING: (ENDS_WITHIN_US, "did not end within 7 s"),
}
_LONGEST_STEP_US: Final = PERIOD_US + LATE_US  # of one check; the rest is a delay of the guardian


def pack_beat(kind: bytes, sent_us: int) -> bytes:
    """Return the packet of a heartbeat."""
    return kind + sent_us.to_bytes(8, "little")


def unpack_beat(packet: bytes) -> tuple[bytes, int]:
    """Return the kind of a heartbeat and the time at which it was sent, us."""
    return packet[:1], int.from_bytes(packet[1:], "little")


class HeartbeatMonitor:
    """Measures the silence of one driver process."""

    def __init__(self, now_us: int) -> None:
        self._looked_us = now_us
        self._last = b""
        self._silence_us = self._own_us = 0
        self._run_us: int | None = None

    @property
    def is_ready(self) -> bool:
        """Return True after the first heartbeat. Before it the driver has moved nothing."""
        return bool(self._last)

    @property
    def drive_failed(self) -> bool:
        """Return True if the drive rejected zero at the end of the driver."""
        return self._last == FAILED

    @property
    def is_running(self) -> bool:
        """Return True if the loop has not announced its end. The end of such a process is an error."""
        return self._last in (AT_REST, MOVING, LOST, STARTING)

    @property
    def is_starting(self) -> bool:
        """Return True while the loop waits for the start of a child."""
        return self._last == STARTING

    @property
    def is_late(self) -> bool:
        """Return True if a heartbeat is missing, so `look` needs the processor time of the driver."""
        return self._silence_us >= LATE_US and self._last not in (b"", IDLE, STARTING)

    def on_beat(self, kind: bytes, sent_us: int) -> None:
        """Note a heartbeat. After ENDING, later heartbeats change nothing."""
        self._last = ENDING if self._last == ENDING else kind
        self._looked_us, self._silence_us, self._own_us, self._run_us = sent_us, 0, 0, None

    def look(self, now_us: int, run_us: int | None = None) -> str:
        """Return why the driver must be killed, or "".

        Args:
            now_us: monotonic time, us.
            run_us: processor time of the driver so far if it is ready to run, us; None if it sleeps or is stopped.
        """
        step_us, self._looked_us = min(now_us - self._looked_us, _LONGEST_STEP_US), now_us
        self._silence_us += step_us
        before_us, self._run_us = self._run_us, run_us
        if run_us is None or before_us is None:
            self._own_us += step_us
        else:
            self._own_us += min(step_us, run_us - before_us)
        return _OUT_OF_CONTROL.get(self._last) or self._reason()

    def _reason(self) -> str:
        if self._last == IDLE:
            return ""
        if self._last in _LIMITS:
            limit_us, reason = _LIMITS[self._last]
            return reason if self._silence_us >= limit_us else ""
        if self._own_us >= HUNG_US:
            return f"no heartbeat for {self._silence_us // 1000} ms"
        if self._last == MOVING and self._silence_us >= STARVED_US:
            return "no processor time for 500 ms; the machine is overloaded"
        return ""


class RestartBudget:
    """At most 5 restarts within 60 s."""

    def __init__(self) -> None:
        self._restarts_us: deque[int] = deque()

    def take(self, now_us: int) -> bool:
        """Take a restart; False if none is left."""
        while self._restarts_us and now_us - self._restarts_us[0] >= RESTART_WINDOW_US:
            self._restarts_us.popleft()
        if len(self._restarts_us) >= MAX_RESTARTS:
            return False
        self._restarts_us.append(now_us)
        return True


def exit_code_after(code: int, end_signal: int | None, *, was_running: bool) -> int | None:
    """Return the exit code of the whole robot after the end of a driver, or None if the driver starts again.

    Args:
        code: exit code of the driver; negative if a signal ended it.
        end_signal: the signal that requested the end of the robot, or None.
        was_running: True if its loop had not announced its end: a library of a plug-in ended the process.
    """
    if end_signal is None:
        return None if code < 0 or was_running else code
    return code if code >= 0 else 128 + end_signal


def needs_zero(code: int, *, was_ready: bool, was_running: bool) -> bool:
    """Return True unless the driver ended by itself with the wheels at zero, or before it could move them."""
    return code < 0 or was_running or (code != 0 and was_ready)
