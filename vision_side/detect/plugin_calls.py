"""Lines for a person, kept until somebody asks for them. Pure."""

from collections import deque
from typing import Final

MAX_NOTICES: Final = 16
"""Lines kept for who asks for them seldom; the oldest go first."""


class Notices:
    """Lines for a person, until somebody takes them; may be added to on another thread."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=MAX_NOTICES)

    def add(self, line: str) -> None:
        """One line."""
        self._lines.append(line)

    def take(self) -> list[str]:
        """All since the last time."""
        lines = []
        while self._lines:
            lines.append(self._lines.popleft())
        return lines
