"""Mock pins of gpiozero that write down what happens to them, and that outlive their process, as real pins do."""

import os
import time
from pathlib import Path

from gpiozero import Device
from gpiozero.pins.mock import MockFactory, MockPWMPin

from sightline.robot_side.hardware.gpio_drive import GpioDrive, GpioDriveConfig

BOARD = "CAR_TEST_BOARD"
"""Names the file of events: `t_us,what,value`, where what is a pin's number, or `gate` for what the driver told."""
LEFT, RIGHT = (10, 9), (8, 7)
OPTIONS = {"wheel_radius_m": 0.0325}


def config(**options) -> GpioDriveConfig:
    """The write-up's car, with these options changed."""
    return GpioDriveConfig(**{**OPTIONS, **options})


class NotingPin(MockPWMPin):
    """Notes every change in its factory's list; a pair is looked at after each."""

    def _change_state(self, value):
        changed = super()._change_state(value)
        if changed and hasattr(self.factory, "events"):
            self.factory.events.append((int(self.info.name.removeprefix("GPIO")), value))
        return changed


class BoardPin(MockPWMPin):
    """Begins as the last process left it, and appends every change to the file of the board."""

    def __init__(self, factory, info):
        super().__init__(factory, info)
        self._number = int(info.name.removeprefix("GPIO"))
        self._state = board_state(Path(os.environ[BOARD])).get(self._number, 0.0)

    def _change_state(self, value):
        changed = super()._change_state(value)
        if changed:
            note(self._number, value)
        return changed


class BoardDrive(GpioDrive):
    """The real drive on such pins; notes what the driver tells it the moment it does."""

    def __init__(self, given: GpioDriveConfig) -> None:
        Device.pin_factory = MockFactory(pin_class=BoardPin)
        super().__init__(given)

    def set(self, left_rad_s, right_rad_s):
        note("gate", max(abs(left_rad_s), abs(right_rad_s)))
        super().set(left_rad_s, right_rad_s)


def note(what, value) -> None:
    """One line, written at once."""
    with Path(os.environ[BOARD]).open("a") as board:
        board.write(f"{time.monotonic_ns() // 1000},{what},{float(value):.4f}\n")


def board_events(path: Path) -> list[tuple[int, str, float]]:
    """(t_us, what, value) of all that happened."""
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [line.split(",") for line in lines]
    return [(int(t_us), what, float(value)) for t_us, what, value in (row for row in rows if len(row) == 3)]


def board_state(path: Path) -> dict[int, float]:
    """The duty of each pin now."""
    return {int(what): value for _, what, value in board_events(path) if what != "gate"}


def both_ways(events) -> bool:
    """Whether any motor's two pins were ever driven at once."""
    state = dict.fromkeys((*LEFT, *RIGHT), 0.0)
    for number, value in events:
        state[number] = value
        if any(state[one] and state[other] for one, other in (LEFT, RIGHT)):
            return True
    return False


class BreakingDrive(BoardDrive):
    """Its fiftieth motion fails on the way to a pin."""

    def __init__(self, given: GpioDriveConfig) -> None:
        super().__init__(given)
        self._left = 50

    def set_duty(self, left, right):
        self._left -= bool(left or right)
        if self._left == 0:
            pins, self._pins = self._pins, _Broken(self._pins)
            try:
                super().set_duty(-left, -right)
            finally:
                self._pins = pins
        super().set_duty(left, right)


class _Broken:
    """Pins that take zero and nothing else."""

    def __init__(self, pins):
        self._pins = pins

    def write(self, number, duty):
        if duty:
            raise OSError("the bridge does not answer")
        self._pins.write(number, duty)

    def enable(self, wanted):
        self._pins.enable(wanted)
