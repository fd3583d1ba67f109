"""Turns one wheel at a time, off the ground, and asks the operator what was seen. Shell.

It goes round the gate, as nothing else does: no network and no camera is needed, and nothing turns before a person, who
stands beside the robot, has said that its wheels are off the ground.
"""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Final

from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.supervision import EXIT_SIGNALS
from sightline.robot_side.plugins import DRIVES
from sightline.robot_side.ports import Drive

TURN_S: Final = 1.0
_SHARE: Final = 0.5
"""Of the robot's top speed: slow enough to see which way a wheel turns."""
Prompt = Callable[[str], str]
Print = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Turn:
    """One wheel, one way."""

    side: str
    way: str
    seen: str

    @property
    def name(self) -> str:
        """In words."""
        return f"{self.side} wheel, {self.way}"

    def speeds(self, speed_rad_s: float) -> tuple[float, float]:
        """(left, right) rad/s."""
        signed = speed_rad_s if self.way == "forward" else -speed_rad_s
        return (signed, 0.0) if self.side == "left" else (0.0, signed)


_SEEN = {"forward": "its top moves away from you, towards the front", "backward": "its top moves towards you"}
TURNS: Final = tuple(Turn(side, way, seen) for side in ("left", "right") for way, seen in _SEEN.items())
_WRONG: Final = {"w": "the wrong way", "o": "the other wheel", "b": "both wheels", "n": "nothing"}


def try_wheels(config: RobotConfig, ask: Prompt | None, say: Print) -> bool:
    """Turn each wheel each way and compare with what should be seen; True if all is as it should be, or nobody says.

    Without `ask` nothing is asked: whoever calls has confirmed that the wheels are off the ground.
    """
    say("stand behind the robot; its wheels must be off the ground and free to turn, your hand near the motors' switch")
    if ask is not None and not _is_yes(ask("are its wheels off the ground? y/n")):
        say("nothing has moved")
        return False
    speed_rad_s = _SHARE * config.safety.max_linear_mps / config.wheels.wheel_radius_m
    advice: list[str] = []
    with opened_drive(config) as drive:
        for turn in TURNS:
            say(f"{turn.name}: {turn.seen}, for {TURN_S:g} s")
            turn_for(drive.set, turn.speeds(speed_rad_s), TURN_S)
            if ask is not None and not _is_yes(ask("was it so? y/n")):
                advice.append(f"{turn.name}: {_advice(config.motors, turn, _what_instead(ask))}")
    for line in dict.fromkeys(advice):
        say(line)
    say("all as it should be" if ask is not None and not advice else "put right what is not, and test again")
    return not advice


@contextmanager
def opened_drive(config: RobotConfig) -> Iterator[Drive]:
    """The robot's drive, at zero and closed at the end, be it Ctrl-C, Ctrl-Z, a signal, a hung-up terminal or a fault.

    Motors keep their last speed when a program just dies, so whatever can be caught is.
    """

    def end(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, end) for number in EXIT_SIGNALS}
    try:
        drive = DRIVES.build(config.motors)
        try:
            yield drive
        finally:
            try:
                drive.set(0.0, 0.0)
            finally:
                drive.close()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def turn_for(give: Callable[[float, float], None], values: tuple[float, float], seconds: float) -> None:
    """Give both values, and zero after that time or at the first trouble."""
    try:
        give(*values)
        time.sleep(seconds)
    finally:
        give(0.0, 0.0)


def _is_yes(answer: str) -> bool:
    return answer.strip().lower() in ("y", "yes")


def _what_instead(ask: Prompt) -> str:
    question = "what turned? w = it, the wrong way; o = the other wheel; b = both; n = nothing"
    while (answer := ask(question).strip().lower()[:1]) not in _WRONG:
        question = "one of w, o, b, n"
    return answer


def _advice(drive: PluginChoice, turn: Turn, wrong: str) -> str:
    """What to change. A drive with options for it is told so; any other is wired differently."""
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
        "n": "nothing turned: is the motors' supply on, the bridge enabled, ground shared, the least duty high enough?",
    }[wrong]


def _pins_of(options: object, side: str) -> str:
    """The side that the pins are named for."""
    other = {"left": "right", "right": "left"}[side]
    return other if getattr(options, "swapped", False) else side


def check_confirmed(confirmed: bool, is_terminal: bool, what: str) -> None:
    """Raise ConfigError where nobody could be asked and nobody has confirmed."""
    if not confirmed and not is_terminal:
        raise ConfigError(f"{what} turns the wheels and there is no terminal to ask at: lift the robot, then add --yes")
