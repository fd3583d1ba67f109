"""Contract of every battery plug-in. Run it over your own: `check_battery(lambda: YourBattery(config))`."""

import math
import threading
import time
from collections.abc import Callable

from sightline.robot_side.ports import Battery

SLOWEST_S = 1.0
"""Limit for one reading; the battery counts as low after 5 s without a reading."""


def check_battery(opened: Callable[[], Battery]) -> None:
    """Every promise in turn, on one battery; an AssertionError names the one that is broken."""
    battery = opened()
    try:
        _reads_volts_in_time(battery)
        _reads_on_another_thread(battery)
    finally:
        battery.close()
        battery.close()  # idempotent


def _reads_volts_in_time(battery: Battery) -> None:
    for _ in range(3):
        began_s = time.monotonic()
        volts = battery.read()
        assert time.monotonic() - began_s < SLOWEST_S
        assert isinstance(volts, float) and math.isfinite(volts) and 0 < volts < 100


def _reads_on_another_thread(battery: Battery) -> None:
    volts: list[float] = []
    thread = threading.Thread(target=lambda: volts.append(battery.read()), name="battery", daemon=True)
    thread.start()
    thread.join(SLOWEST_S)
    assert volts, "read must work on a thread other than the one that opened it"
