"""The detector port: `Detector`, and what it returns. Pure."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vision_side.decode import Picture


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle in pixels of the encoded picture."""

    cx_px: float
    cy_px: float
    radius_px: float


@dataclass(frozen=True, slots=True)
class Detection:
    """One object, in pixels of the encoded picture; (0, 0) is the top-left corner of the top-left pixel.

    `x2_px` and `y2_px` are exclusive. `score` (0..1) is how sure the detector is; of an outline, the share that is the
    object's own. `outline_px` (N, 2) is the part of its edge that is in view, where the detector knows it: edges that
    the picture's border or another object made are left out.
    """

    x1_px: float
    y1_px: float
    x2_px: float
    y2_px: float
    score: float
    label: str
    circle: Circle | None = None
    outline_px: NDArray[np.float64] | None = field(default=None, compare=False, repr=False)


class Detector(Protocol):
    """Finds objects in one picture."""

    def detect(self, picture: Picture) -> tuple[Detection, ...]:
        """What is in `picture`, best first. Empty means "saw nothing"; raises nothing for any picture."""
        ...
