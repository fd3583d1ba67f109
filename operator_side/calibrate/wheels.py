"""Turns one wheel at a time, off the ground, and compares it with the answers of the operator. Shell.

Only this command bypasses the gate: it needs no network and no camera. No wheel turns before an operator next to the
robot confirms that the wheels are off the ground.
"""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Final

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.supervision import EXIT_SIGNALS
from sightline.robot_side.guardian.core import IDLE, MOVING
from sightline.robot_side.guardian.start import GuardianEnd
from sightline.robot_side.plugins import DRIVES
from sightline.robot_side.ports import Drive

TURN_S: Final = 1.0
_SHARE: Final = 0.5
"""Share of the robot's top speed, slow enough to see the direction of a wheel."""
_BEAT_S: Final = 0.02
Prompt = Callable[[str], str]
Guard = Callable[[RobotConfig], GuardianEnd]
Print = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Turn:
    """One wheel and one direction."""

    side: str
    way: str
    seen: str

    @property
    def name(self) -> str:
        """Return the name of the test."""
        return f"{self.side} wheel, {self.way}"

    def speeds(self, speed_rad_s: float) -> tuple[float, float]:
        """Return (left, right) in rad/s."""
        signed = speed_rad_s if self.way == "forward" else -speed_rad_s
        return (signed, 0.0) if self.side == "left" else (0.0, signed)


_SEEN = {"forward": "its top moves away from you, towards the front", "backward": "its top moves towards you"}
TURNS: Final = tuple(Turn(side, way, seen) for side in ("left", "right") for way, seen in _SEEN.items())
_WRONG: Final = {"w": "the wrong way", "o": "the other wheel", "b": "both wheels", "n": "nothing"}


def try_wheels(config: RobotConfig, prompt: Prompt | None, show: Print, guard: Guard | None = None) -> bool:
    """Turn each wheel in each direction and compare it with the answers of the operator.

    Args:
        prompt: shows a question and returns the answer; None if it is confirmed that the wheels are off the ground.
        show: prints a line.
        guard: makes this process the guardian of its fork, in which this function continues.

    Returns:
        True if all answers are right, or without `prompt`.
    """
    show("stand behind the robot; its wheels must be off the ground and free, your hand near the motors' switch")
    if prompt is not None and not _is_yes(prompt("are its wheels off the ground? y/n")):
        show("nothing moved")
        return False
    speed_rad_s = _SHARE * config.safety.max_linear_mps / config.wheels.wheel_radius_m
    advice: list[str] = []
    with opened_drive(config, guard) as (drive, guardian):
        for turn in TURNS:
            show(f"{turn.name}: {turn.seen}, for {TURN_S:g} s")
            turn_for(drive.set, turn.speeds(speed_rad_s), TURN_S, guardian)
            if prompt is not None and not _is_yes(prompt("is that right? y/n")):
                advice.append(f"{turn.name}: {_advice(config.motors, turn, _what_instead(prompt))}")
    for line in dict.fromkeys(advice):
        show(line)
    if prompt is None:
        show("each wheel was turned; compare what you saw with these lines")
    else:
        show("correct the errors and test again" if advice else "all wheels turn as expected")
    return not advice


@contextmanager
def opened_drive(config: RobotConfig, guard: Guard | None = None) -> Iterator[tuple[Drive, GuardianEnd | None]]:
    """Open the robot's drive. Set it to zero and close it at any end: Ctrl-C, Ctrl-Z, a signal, hang-up or an error.

    Motors keep their last speed when a program is killed, so all signals that can be caught are caught. The guardian
    covers the others.
    """
    guardian = guard(config) if guard is not None else None
    if guardian is not None:
        guardian.wait()

    def end(_number: int, _frame: FrameType | None) -> None:
        for number in EXIT_SIGNALS:  # a second signal, from the guardian, must not interrupt the ramp to zero
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, end) for number in EXIT_SIGNALS}
    try:
        drive = DRIVES.build(config.motors)
        if guardian is not None:
            guardian.beat(IDLE)
        try:
            yield drive, guardian
        finally:
            try:
                drive.set(0.0, 0.0)
            finally:
                drive.close()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def turn_for(
    give: Callable[[float, float], None], values: tuple[float, float], seconds: float, guardian: GuardianEnd | None
) -> None:
    """Set both values, and zero after that time or after an error. Raises HardwareError if the guardian is gone.

    The values are repeated at the rate of the control loop, for controllers and cutoffs that stop without commands.
    """
    end_s = time.monotonic() + seconds
    try:
        while (left_s := end_s - time.monotonic()) > 0:
            give(*values)
            if guardian is not None:
                guardian.beat(MOVING)
                if guardian.is_gone():
                    raise HardwareError("the guardian of this command has died; start it again")
            time.sleep(min(left_s, _BEAT_S))
    finally:
        give(0.0, 0.0)
        if guardian is not None:
            guardian.beat(IDLE)


def _is_yes(answer: str) -> bool:
    return answer.strip().lower() in ("y", "yes")


def _what_instead(prompt: Prompt) -> str:
    question = "what turned? w = it, the wrong way; o = the other wheel; b = both; n = nothing"
    while (answer := prompt(question).strip().lower()[:1]) not in _WRONG:
        question = "one of w, o, b, n"
    return answer


def _advice(drive: PluginChoice, turn: Turn, wrong: str) -> str:
    """Return the necessary change: an option if the drive has one, otherwise the wiring."""
    plugin, options = DRIVES.load(drive)
    known = plugin.Config.model_fields
    if wrong == "w" and "left_reversed" in known:
        name = f"{_pins_of(options, turn.side)}_reversed"
        return f"it turned the wrong way: set drive.options.{name} = {str(not getattr(options, name)).lower()}"
    if wrong == "o" and "swapped" in known:
        return f"the other wheel turned: set drive.options.swapped = {str(not options.swapped).lower()}"
    return {
        "w": f"it turned the wrong way: exchange the two wires of the {turn.side} motor",
        "o": "the other wheel turned: exchange the motors' plugs",
        "b": "both wheels turned: two wires of different motors touch, or share an input of the bridge",
        "n": "nothing turned: check the motors' supply, the bridge's enable pin, the shared ground and the least duty",
    }[wrong]


def _pins_of(options: object, side: str) -> str:
    """Return the side in the pin names, after `swapped`."""
    other = {"left": "right", "right": "left"}[side]
    return other if getattr(options, "swapped", False) else side


def check_confirmed(confirmed: bool, is_terminal: bool, what: str, precaution: str) -> None:
    """Raise ConfigError, with the precaution, without a confirmation and a terminal to request it."""
    if not confirmed and not is_terminal:
        raise ConfigError(f"{what} turns the wheels and has no terminal to confirm on; {precaution}, then add --yes")
