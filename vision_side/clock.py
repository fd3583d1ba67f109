"""This machine's monotonic clock, that of deadlines and ages. Shell."""

import time


def now_us() -> int:
    """Microseconds since some fixed moment."""
    return time.monotonic_ns() // 1000
