"""What a robot's wheels were told, as its log drive notes it, held against when something was harmed. Pure."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple


class Told(NamedTuple):
    """One line of the log drive's file."""

    t_us: int
    left_rad_s: float
    right_rad_s: float

    @property
    def moves(self) -> bool:
        """Whether a wheel is to turn."""
        return bool(self.left_rad_s or self.right_rad_s)


def read_told(text: str) -> list[Told]:
    """Whole lines; one that is still being written is left out."""
    parts = [line.split(",") for line in text.split("\n")[:-1]]
    return [Told(int(t), float(left), float(right)) for t, left, right in parts]


def moves_again_s(rows: Sequence[Told], since_us: int, until_us: int) -> float | None:
    """From `since_us` to the end of the longest standstill that ends after it, up to `until_us`.

    0 if the wheels never stood; None if they did not turn again, or nothing is known.
    """
    inside = [row for row in rows if row.t_us < until_us]
    if not inside or not inside[-1].moves:
        return None
    stood_us = [(end_us - begin_us, end_us) for begin_us, end_us in _stands(inside) if end_us > since_us]
    return (max(stood_us)[1] - since_us) / 1e6 if stood_us else 0.0


def _stands(rows: Sequence[Told]) -> Iterator[tuple[int, int]]:
    """When each standstill began, and when it was over."""
    begin_us: int | None = None
    for row in rows:
        if not row.moves:
            begin_us = row.t_us if begin_us is None else begin_us
        elif begin_us is not None:
            yield begin_us, row.t_us
            begin_us = None
