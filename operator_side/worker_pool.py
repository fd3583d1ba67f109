"""Work on several processes that ends when it is told to. Shell (processes)."""

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager

from sightline.protocol.errors import HardwareError


@contextmanager
def worker_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """So many, for as long as the context lasts. Left by an error, what has not begun never does: a pool by itself
    would first do all of it. Ctrl-C at the terminal, which every process hears, ends them at once.

    Spawned, since a forked child would share PyBullet's state. Raises HardwareError when something else ends one.
    """
    at_once = (signal.SIGINT, signal.SIG_DFL)  # an exception would only end what each does now, and begin the next
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), signal.signal, at_once) as pool:
        try:
            yield pool
        except BrokenProcessPool:
            fewer = "; --jobs 1 needs less of it" if jobs > 1 else ""
            said = f"a worker (of {jobs}) was ended from outside, perhaps as memory ran out{fewer}"
            raise HardwareError(said) from None
        except BaseException:
            pool.shutdown(cancel_futures=True)  # waits: the pool's own end would take it back
            raise
