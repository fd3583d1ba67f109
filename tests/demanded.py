"""What a test may do without on a person's machine, and what it must have where a run demands it: CI names it.

    TESTS_DEMAND=triton,cuda make test

Not a name that begins with SIGHTLINE_: those are settings, and one that is none is refused.
"""

import os

import pytest

NAME = "TESTS_DEMAND"


def do_without(what, why):
    """Skip, saying why; fail with that line where `what` is demanded."""
    if what in os.environ.get(NAME, "").split(","):
        pytest.fail(f"{NAME} names {what!r}, and it cannot be had: {why}", pytrace=False)
    pytest.skip(why)
