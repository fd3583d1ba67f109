"""What every peer's vision is handed: something that answers pictures. Pure."""

from typing import Protocol


class Vision(Protocol):
    """Pictures in, `linear|angular` out."""

    def answer(self, t_us: int, jpeg: bytes, /) -> str:
        """The command for a picture captured at `t_us`. Raises ValueError for one that cannot be answered."""
        ...
