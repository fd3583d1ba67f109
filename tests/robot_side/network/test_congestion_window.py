"""The congestion window, answer by answer: when it widens, when it narrows, how long it then waits."""

import pytest

from sightline.robot_side.network.congestion_window import AckSample, CongestionWindow

INTERVAL_US = 33_333
FAR_US = 100_000
"""A link of this delay carries four frames at once."""
FRAME_BYTES = 10_000


class Window:
    """A window and its clock; each answer comes one interval after the one before it."""

    def __init__(self, most=12, now_us=1_000_000):
        self.window = CongestionWindow(INTERVAL_US, most)
        self.now_us = now_us

    @property
    def frames(self):
        return self.window.frames

    def answer(self, delay_us, *, behind=True, followed=True, held_back=True, gap_us=INTERVAL_US, frames=1,
               size_bytes=FRAME_BYTES, compute_us=0, after_us=INTERVAL_US):
        self.now_us += after_us
        sample = AckSample(delay_us, behind, followed, held_back, gap_us, frames, frames * size_bytes, compute_us)
        return self.window.on_answer(sample, self.now_us)

    def alone(self, delay_us, **changes):
        return self.answer(delay_us, behind=False, followed=False, **changes)

    def widened(self):
        """Measure a far link until the window is open."""
        for _ in range(3):
            self.alone(FAR_US)
        for _ in range(30):
            self.answer(FAR_US)
        return self


def pause_us(window):
    """Return the time from now until the window widens, on a link without a queue."""
    started_us, frames = window.now_us, window.frames
    while window.frames == frames:
        window.alone(FAR_US, after_us=1_000)
        assert window.now_us - started_us < 10_000_000
    return window.now_us - started_us


@pytest.mark.parametrize(("answers", "held_us", "paused_us"), [
    (12, 1_000_000, 500_000), (11, 1_000_000, 1_000_000), (12, 999_999, 1_000_000),
    (11, 3_000_000, 1_000_000), (40, 900_000, 1_000_000),
])  # fmt: skip
def test_pause_stays_short_only_if_the_window_held_for_a_second_and_for_twelve_answers(answers, held_us, paused_us):
    """Otherwise the width is the likely cause of the queue."""
    window = Window(most=2)
    for _ in range(2):
        window.alone(FAR_US)
    assert window.frames == 2
    until_us = window.now_us + held_us
    for left in reversed(range(answers)):
        last_us = until_us - window.now_us if left == 0 else 1_000
        if left > 1:
            window.alone(FAR_US, after_us=last_us)
        else:
            window.answer(220_000, after_us=last_us)
    assert window.frames == 1
    assert pause_us(window) == paused_us
