"""Why a remote detector gave no answer that counts: one list, one exception, one tally. Pure."""

from collections import Counter
from enum import StrEnum
from typing import Final

from sightline.vision_side.detect.plugin_calls import Notices

_LONGEST: Final = 160
_TOLD_AT: Final = frozenset(10**power for power in range(10))
"""A server gone bad is told at the 1st, 10th, 100th ... refusal of a kind, when it is good again, and when it is bad
again."""
_IN_A_ROW: Final = 10
"""Of answers that were good before, or of refusals: from so many on it is bad again. Fewer come and go, as where one
robot of several is not answered; a line for each of them would be one for each frame."""


class NoAnswerReason(StrEnum):
    """What is counted. All of them mean "no answer": none of them moves the robot."""

    LATE = "LATE"  # not there by the deadline
    UNREACHABLE = "UNREACHABLE"  # nobody there, or gone in the middle of it
    REFUSED = "REFUSED"  # it answered with an error of its own
    TOO_LARGE = "TOO_LARGE"  # more bytes than any answer needs
    ENCODED = "ENCODED"  # compressed, which was not asked for; never unpacked
    MALFORMED = "MALFORMED"  # not the protocol: grammar, type, shape
    NOT_FINITE = "NOT_FINITE"  # a box or score that is no number
    TOO_MANY = "TOO_MANY"  # more boxes than any scene has
    OTHER_FRAME = "OTHER_FRAME"  # it names another frame than the one it was asked about
    OTHER_SIZE = "OTHER_SIZE"  # it looked at a picture of another size
    UNFIT = "UNFIT"  # its model takes or gives what this end does not speak
    BAD_PICTURE = "BAD_PICTURE"  # the robot's own frame is none: nobody was asked


class NoAnswerError(Exception):
    """There is no answer that counts; `detail` is one line for a person."""

    def __init__(self, reason: NoAnswerReason, detail: str) -> None:
        self.reason = reason
        self.detail = " ".join(detail.split())[:_LONGEST]
        super().__init__(f"{reason}: {self.detail}")


class ErrorCounters:
    """Counts what was refused of one remote, and says so where that is news."""

    def __init__(self, name: str) -> None:
        self.refused: Counter[str] = Counter()
        self.news = Notices()
        self._name = name
        self._said = ""
        self._good = self._bad = 0
        """In a row."""

    def refuse(self, error: NoAnswerError) -> None:
        """Count it."""
        self.refused[error.reason] += 1
        count, good_before = self.refused[error.reason], self._good
        self._good, self._bad = 0, self._bad + 1
        again = self._said == "good" and (good_before >= _IN_A_ROW or self._bad == _IN_A_ROW)
        if again or count in _TOLD_AT:
            self._said = error.reason
            self.news.add(f"detector {self._name}: no answer: {error.reason}: {error.detail} ({count} so far)")

    def good(self) -> None:
        """An answer that counts."""
        self._good, self._bad = self._good + 1, 0
        if self._said != "good":
            before, self._said = self._said, "good"
            self.news.add(f"detector {self._name} answers" + (" again" if before else ""))
