"""Which session of a robot to steer by, when frames of more than one arrive. Pure.

A robot that starts anew begins a session, and is met at once: the newest session is the one. Yet anybody on a plain
network can send one frame of a new session, and two robots may have one id. So an earlier session that goes on, while
the newer one should be all there is, is taken back: a robot that started anew cannot also be as it was before. From
then on it is only replaced when it has fallen silent.
"""

from dataclasses import dataclass
from typing import Final

GOES_ON_US: Final = 300_000
"""An earlier session is alive if frames of it were captured, and came, over this long: more than a late frame or two
that the network held back, and as little as a robot without answers can show (it sends one every 120 to 500 ms)."""
SILENT_US: Final = 1_000_000
"""A session that is not heard for longer may be replaced: the slowest stream sends twice as often, and no robot starts
anew so fast."""
KEPT: Final = 8
"""Earlier sessions remembered, those heard last. One that is forgotten counts as new."""


@dataclass(slots=True)
class _Earlier:
    """A session that another replaced: since when it is heard again, by our clock and by its own, and when last."""

    heard_us: int
    again_us: int = 0
    captured_us: int = 0

    def goes_on(self, captured_us: int, now_us: int) -> bool:
        """Whether, with this frame, it was heard for so long that it cannot be over."""
        if not self.again_us or now_us - self.heard_us > SILENT_US:
            self.again_us, self.captured_us = now_us, captured_us
        self.heard_us = now_us
        return min(now_us - self.again_us, captured_us - self.captured_us) >= GOES_ON_US


class SessionSelector:
    """Judges every frame by its session. Times are of this machine's clock, but for `captured_us`, the robot's."""

    def __init__(self) -> None:
        self.current = ""
        self._heard_us = 0
        self._proven = False
        """Whether the current one was heard beside another: then another is no sign that it is over."""
        self._earlier: dict[str, _Earlier] = {}

    def admits(self, session: str, captured_us: int, now_us: int) -> bool:
        """Whether a frame of `session` is of the robot that is steered; it may become so by this very frame."""
        if session != self.current:
            if not self._replaces(session, captured_us, now_us):
                return False
            self._follow(session)
        self._heard_us = now_us
        return True

    def _replaces(self, session: str, captured_us: int, now_us: int) -> bool:
        if self._proven and now_us - self._heard_us <= SILENT_US:
            return False
        earlier = self._earlier.get(session)
        if earlier is not None and not earlier.goes_on(captured_us, now_us):
            return False
        self._proven = earlier is not None
        return True

    def _follow(self, session: str) -> None:
        self._earlier.pop(session, None)
        if self.current:
            self._earlier[self.current] = _Earlier(self._heard_us)
        if len(self._earlier) > KEPT:
            del self._earlier[min(self._earlier, key=lambda name: self._earlier[name].heard_us)]
        self.current = session
