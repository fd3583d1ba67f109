"""The monotonic clock of this machine, and the age of stamps of a robot whose clock is another. Shell (a clock)."""

import time


def monotonic_us() -> int:
    """Microseconds since some fixed moment."""
    return time.monotonic_ns() // 1000


# How old a robot's stamp is, without synchronized clocks: checked against its quickest messages. Pure.
#
# The delay of the quickest message of a session cannot be separated from the offset of the clocks, so ages are lower
# bounds: what they leave out is one way of the link at its best.


class RobotClock:
    """One robot's monotonic clock as seen from here, again for each session."""

    def __init__(self) -> None:
        self._session = ""
        self._offset_us = 0

    def update(self, session: str, t_us: int, now_us: int) -> None:
        """A message that the robot published at `t_us` of its clock arrived at `now_us` of ours."""
        offset_us = now_us - t_us
        if session != self._session:
            self._session, self._offset_us = session, offset_us
        self._offset_us = min(self._offset_us, offset_us)

    def age_us(self, session: str, t_us: int, now_us: int) -> int | None:
        """How long ago `t_us` was, at the least; None for a session other than the current one."""
        if not session or session != self._session:
            return None
        return max(0, now_us - t_us - self._offset_us)
