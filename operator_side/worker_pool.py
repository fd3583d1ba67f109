"""Work on several processes that ends when it is told to. Shell (processes)."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager


@contextmanager
def worker_pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """So many, for as long as the context lasts. Left by Ctrl-C or an error, what has not begun never does: a pool by
    itself would first do all of it.

    Spawned, since a forked child would share PyBullet's state.
    """
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(cancel_futures=True)  # waits: the pool's own end would take it back
            raise
