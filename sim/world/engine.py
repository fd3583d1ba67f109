"""PyBullet, imported without its printed build time. Shell (file descriptors).

Every file that needs it takes it from here: `from sightline.sim.world.engine import pybullet`.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt


@contextmanager
def _silenced() -> Iterator[None]:
    """Hide stdout while PyBullet loads. Its message comes from C, not `sys.stderr`; errors still raise."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


with _silenced():
    import pybullet

__all__ = ["camera_arrays", "pybullet"]

CameraArrays = tuple[npt.NDArray[np.uint8], npt.NDArray[np.float32], npt.NDArray[np.int32]]


def camera_arrays(image: Sequence[Any]) -> CameraArrays:
    """Read the result of `pybullet.getCameraImage`, whether PyBullet was compiled with or without NumPy.

    Without NumPy the pixels are flat tuples; with NumPy they are arrays, which are not copied.

    Args:
        image: width, height, RGBA, depth and segmentation mask, as PyBullet returns them.

    Returns:
        RGBA (height x width x 4), depth (height x width, 0 near to 1 far), segmentation mask (height x width).
    """
    width_px, height_px, rgba, depth, mask = image
    size = (height_px, width_px)
    return (
        np.asarray(rgba, np.uint8).reshape(*size, 4),
        np.asarray(depth, np.float32).reshape(size),
        np.asarray(mask, np.int32).reshape(size),
    )
