"""Work on several processes that is interrupted."""

import signal
import time
from concurrent.futures.process import BrokenProcessPool

import pytest

from sightline.evaluation.processes import worker_pool
from sightline.protocol.errors import HardwareError


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_has_not_begun_is_dropped_when_it_is_over(error):
    with pytest.raises(error), worker_pool(1) as pool:
        waiting = [pool.submit(time.sleep, 0.05) for _ in range(100)]
        waiting[0].result()
        raise error
    done = [not one.cancelled() for one in waiting]
    assert done[0] and sum(done) < 20 and all(one.done() for one in waiting)


def test_ctrl_c_ends_what_has_begun_and_what_was_to_be_next():
    with worker_pool(1) as pool:
        for one in [pool.submit(signal.raise_signal, signal.SIGINT), pool.submit(time.sleep, 30)]:
            with pytest.raises(BrokenProcessPool):
                one.result(timeout=10)


def test_a_process_that_something_else_ended_is_one_line_that_says_what_helps():
    with pytest.raises(HardwareError, match=r"of 2\) was ended .*--jobs 1"), worker_pool(2) as pool:
        pool.submit(signal.raise_signal, signal.SIGTERM).result(timeout=10)


def test_all_is_done_when_nothing_happens():
    with worker_pool(2) as pool:
        waiting = [pool.submit(pow, 2, number) for number in range(20)]
    assert [one.result() for one in waiting] == [2**number for number in range(20)]
