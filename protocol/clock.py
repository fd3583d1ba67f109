"""This machine's monotonic clock, that of deadlines, ages and stamps: one for all its processes. Shell."""

import time


def monotonic_us() -> int:
    """Microseconds since some fixed moment."""
    return time.monotonic_ns() // 1000
