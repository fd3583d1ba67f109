"""PyBullet, imported without the build time that it prints. Shell (file descriptors).

Every file that needs it takes it from here: `from sightline.sim.world.engine import pybullet`.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _silenced() -> Iterator[None]:
    """The message comes from C, past `sys.stderr`; what fails while silent still raises."""
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

__all__ = ["pybullet"]
