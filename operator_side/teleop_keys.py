"""What keys mean to `sightline teleop`, and whether one is still held. Pure.

A terminal tells presses and repeats, never releases. So a key counts as held for a little longer than its repeats are
apart, which is learnt from the repeats themselves; before the first repeat, a little longer than the terminal's delay.
"""

from dataclasses import dataclass
from typing import Final

MOVES: Final[dict[str, tuple[int, int]]] = {
    "u": (1, 1), "i": (1, 0), "o": (1, -1),
    "j": (0, 1), "l": (0, -1),
    "m": (-1, -1), ",": (-1, 0), ".": (-1, 1),
    "\x1b[A": (1, 0), "\x1b[B": (-1, 0), "\x1b[D": (0, 1), "\x1b[C": (0, -1),
}  # fmt: skip
"""Key -> share of (linear, angular) speed. Back and to the left turns clockwise, as a car that backs up does."""
SPEEDS: Final[dict[str, tuple[int, int]]] = {
    "q": (1, 1), "z": (-1, -1), "w": (1, 0), "x": (-1, 0), "e": (0, 1), "c": (0, -1),
}  # fmt: skip
"""Key -> whether (linear, angular) speed goes up or down."""
STOPS: Final = ("k", " ", "\x1b[E")
HAND_OVER: Final = "a"
MOST_AT_ONCE: Final = 4
"""Keys of one read that hands on a keyboard may bring: at 30 repeats a second, what comes in 130 ms."""

_FIRST_DELAY_US: Final = 500_000
"""From a press to its first repeat on most desktops, until it is learnt."""
_SLACK: Final = 1.3
_LONGEST_FIRST_US: Final = 900_000
_FIRST_INTERVAL_US: Final = 35_000
_INTERVALS: Final = 3
_SHORTEST_HOLD_US: Final = 80_000
LONGEST_HOLD_US: Final = 120_000
"""With the period of the commands on top, a release is a zero command within 150 ms."""
_REPEATS_WITHIN_US: Final = 150_000
"""What comes later is another press."""
_FORGOTTEN_US: Final = 1_000_000
FRESH_US: Final = 300_000
"""A press after this long without any is a new decision to drive: only such a one arms a robot."""


def split_keys(text: str) -> list[str]:
    """The keys of what was read: an arrow is three characters. What is cut off or unknown stays as single ones."""
    keys: list[str] = []
    at = 0
    while at < len(text):
        length = 3 if text[at : at + 2] in ("\x1b[", "\x1bO") else 1
        keys.append(text[at : at + length].replace("\x1bO", "\x1b["))
        at += length
    return keys


@dataclass(slots=True)
class Hold:
    """The movement key that is held, as far as repeats tell."""

    key: str = ""
    delay_us: int = _FIRST_DELAY_US
    interval_us: int = _FIRST_INTERVAL_US
    _presses: int = 0
    _first_gap_us: int = 0
    _last_us: int | None = None

    def press(self, key: str, now_us: int) -> bool:
        """A movement key came, pressed or repeated. True for a fresh press, after a while without any."""
        gap_us = _FORGOTTEN_US if self._last_us is None else now_us - self._last_us
        if gap_us == 0 and key == self.key:
            return False  # several repeats of one read
        self._last_us = now_us
        if self._is_repeat(key, gap_us):
            self._learn(gap_us)
            self._presses += 1
            return False
        self.key, self._presses = key, 1
        return gap_us >= FRESH_US

    def _is_repeat(self, key: str, gap_us: int) -> bool:
        """The first repeat comes after the terminal's delay, the others soon after one another."""
        return key == self.key and gap_us < (_FORGOTTEN_US if self._presses == 1 else _REPEATS_WITHIN_US)

    def _learn(self, gap_us: int) -> None:
        """The delay is believed once a quick repeat has followed it: somebody who taps has none."""
        if self._presses == 1:
            self._first_gap_us = gap_us
            return
        if self._presses == 2 and self._first_gap_us > _REPEATS_WITHIN_US:
            self.delay_us = self._first_gap_us
        self.interval_us += (gap_us - self.interval_us) // 4

    def release(self) -> None:
        """Nothing is held any more."""
        self.key, self._presses = "", 0

    def miss(self, now_us: int) -> None:
        """Keys came that tell nothing of now; what follows them is no fresh press."""
        self.release()
        self._last_us = now_us

    def is_held(self, now_us: int) -> bool:
        """Whether the key has to be taken as held."""
        return bool(self.key) and self._last_us is not None and now_us - self._last_us <= self.patience_us

    @property
    def patience_us(self) -> int:
        """How long after the last press or repeat the key counts as held."""
        if self._presses <= 1:
            return min(_LONGEST_FIRST_US, round(self.delay_us * _SLACK))
        return max(_SHORTEST_HOLD_US, min(LONGEST_HOLD_US, _INTERVALS * self.interval_us))
