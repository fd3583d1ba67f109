"""Contract of every drive plug-in. Run it over your own: `check_drive(lambda: YourDrive(config), zero)`.

The wheels turn: lift the robot.
"""

import time
from collections.abc import Callable

from sightline.robot_side.ports import Drive, WheelAngles

QUICK_S = 0.05
"""For one call: the driver's period is 20 ms, and a call that takes longer delays every other duty of it."""
TURNING_S = 0.3
SPEED_RAD_S = 6.0
STILL_S = 2.0
"""Motors may follow with their lag; a simulation on a busy machine may be late."""


def check_drive(opened: Callable[[], Drive], zero: Callable[[], None], speed_rad_s: float = SPEED_RAD_S) -> None:
    """Every promise in turn, on one drive; an AssertionError names the one that is broken.

    Args:
        opened: creates the drive.
        zero: calls its `zero` with the same configuration as plain values.
        speed_rad_s: a speed that the wheels reach.
    """
    drive = opened()
    try:
        _gives_readings_in_order(drive)
        _is_quick_whatever_it_is_told(drive, speed_rad_s)
        _keeps_the_last_speeds(drive, speed_rad_s)
        _turns_each_wheel_its_own_way(drive, speed_rad_s)
        _stands_still_at_zero(drive, speed_rad_s)
    finally:
        drive.set(0.0, 0.0)
        drive.close()
        drive.close()  # idempotent
    _stops_after_its_process(opened, zero, speed_rad_s)


def _gives_readings_in_order(drive: Drive) -> None:
    earlier_us = 0
    for _ in range(5):
        reading = drive.wheels()
        if reading is not None:
            assert isinstance(reading, WheelAngles)
            assert type(reading.t_us) is int
            assert earlier_us <= reading.t_us <= time.monotonic_ns() // 1000, "times rise and are not in the future"
            earlier_us = reading.t_us
        time.sleep(0.02)


def _is_quick_whatever_it_is_told(drive: Drive, speed_rad_s: float) -> None:
    ordinary = [(speed_rad_s, speed_rad_s), (-speed_rad_s, speed_rad_s)]
    told = [*ordinary, (1e3, -1e3), (-1e-9, 1e-9), (-0.0, 0.0), (0.0, 0.0)]
    slowest_s = 0.0
    for pair in told * 3:
        started_s = time.monotonic()
        drive.set(*pair)
        drive.wheels()
        slowest_s = max(slowest_s, time.monotonic() - started_s)
    assert slowest_s < QUICK_S, f"a call took {slowest_s * 1e3:.0f} ms"


def _keeps_the_last_speeds(drive: Drive, speed_rad_s: float) -> None:
    """Check that the motors latch a speed that no call repeats."""
    drive.set(speed_rad_s, speed_rad_s)
    first = _turned(drive)
    later = _turned(drive)
    if first is not None and later is not None:
        assert min(first) > 0 and min(later) > 0, f"{first} then {later} rad: both wheels go on forwards"


def _turns_each_wheel_its_own_way(drive: Drive, speed_rad_s: float) -> None:
    for left, right in ((-1, 1), (1, -1)):
        drive.set(left * speed_rad_s, right * speed_rad_s)
        time.sleep(TURNING_S)  # a reversal takes a motor some time
        turned = _turned(drive)
        if turned is not None:
            assert turned[0] * left > 0 and turned[1] * right > 0, f"{turned} rad for {(left, right)}"


def _stands_still_at_zero(drive: Drive, speed_rad_s: float) -> None:
    drive.set(speed_rad_s, speed_rad_s)
    time.sleep(TURNING_S)
    drive.set(0.0, 0.0)
    deadline_s = time.monotonic() + STILL_S
    while (turned := _turned(drive)) is not None and max(map(abs, turned)) >= 0.05:
        assert time.monotonic() < deadline_s, f"the wheels still turn: {turned} rad in {TURNING_S} s"


def _stops_after_its_process(opened: Callable[[], Drive], zero: Callable[[], None], speed_rad_s: float) -> None:
    """`zero` stops the wheels of a drive that was left, and leaves the device to the next drive."""
    left = opened()
    left.set(speed_rad_s, speed_rad_s)
    left.close()
    zero()
    zero()  # idempotent
    drive = opened()
    try:
        deadline_s = time.monotonic() + STILL_S
        while (turned := _turned(drive)) is not None and max(map(abs, turned)) >= 0.05:
            assert time.monotonic() < deadline_s, f"zero leaves the wheels turning: {turned} rad in {TURNING_S} s"
    finally:
        drive.close()


def _turned(drive: Drive) -> tuple[float, float] | None:
    """Radians in a while; None without encoders."""
    before = drive.wheels()
    time.sleep(TURNING_S)
    after = drive.wheels()
    if before is None or after is None:
        return None
    return after.left_rad - before.left_rad, after.right_rad - before.right_rad
