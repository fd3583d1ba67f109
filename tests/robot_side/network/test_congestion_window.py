"""The congestion window, answer by answer: when it widens, when it narrows, how long it then waits."""

import pytest

from sightline.robot_side.network.congestion_window import AckSample, CongestionWindow, LinkCapacity

INTERVAL_US = 40_000
FAR_US = 100_000
"""A link of this delay."""
FAR_FRAMES = 4
"""So many frames are captured while one is in flight there: 1 + (100 + 20) // 40 ms."""
GROSS_US = 180_001
"""Just above 1.75 times FAR_US and 5 ms."""


class Window:
    """A window and its clock."""

    def __init__(self, most=12, now_us=1_000_000):
        self.window = CongestionWindow(INTERVAL_US, most)
        self.now_us = now_us

    @property
    def frames(self):
        return self.window.frames

    def answer(self, delay_us, *, behind=True, followed=True, held_back=True, gap_us=INTERVAL_US, frames=1,
               size_bytes=10_000, compute_us=0, after_us=1_000):
        """Give the answer of a frame that waited behind another one, unless stated otherwise."""
        self.now_us += after_us
        sample = AckSample(delay_us, behind, followed, held_back, gap_us, frames, frames * size_bytes, compute_us)
        return self.window.on_answer(sample, self.now_us)

    def alone(self, delay_us=FAR_US, **changes):
        """Give the answer of a frame that had the link to itself."""
        return self.answer(delay_us, **{"behind": False, "followed": False, **changes})

    def changes(self, answers, delay_us=FAR_US, **changes):
        """Return (number of the answer, frames) of each change."""
        found, before = [], self.frames
        for number in range(1, answers + 1):
            self.answer(delay_us, **changes)
            if self.frames != before:
                found.append((number, self.frames))
            before = self.frames
        return found

    def narrowed(self, **changes):
        """Let two frames wait grossly, at most two in flight; return the capacity of the link."""
        assert self.frames == 2
        self.answer(10 * FAR_US, **changes)
        full = self.answer(10 * FAR_US, **changes)
        assert self.frames == 1
        return full

    def pause_us(self, delay_us=FAR_US, **changes):
        """Return the time from now until the window widens, on a link without a queue."""
        started_us, frames = self.now_us, self.frames
        while self.frames == frames:
            self.alone(delay_us, **changes)
            assert self.now_us - started_us < 60_000_000
        return self.now_us - started_us

    def widens_after(self, pause_us, delay_us=FAR_US, **changes):
        """Return True if the window widens that many microseconds from now, and not one earlier."""
        frames = self.frames
        self.alone(delay_us, after_us=pause_us - 2, **changes)
        self.alone(delay_us, after_us=1, **changes)
        early = self.frames != frames
        self.alone(delay_us, after_us=1, **changes)
        return not early and self.frames > frames


def two_in_flight(delay_us=FAR_US, most=2):
    """Return a window that has just widened to two frames."""
    window = Window(most)
    window.alone(delay_us)
    window.alone(delay_us)
    assert window.frames == 2
    return window


# --- the delay of the link itself --------------------------------------------------------------------------------


def test_own_delay_is_the_least_of_the_last_three_frames_that_were_alone():
    window, seen = Window(), []
    assert window.window.own_delay_us is None
    for delay_us in (100_000, 110_000, 120_000, 130_000, 90_000):
        window.alone(delay_us)
        seen.append(window.window.own_delay_us)
    assert seen == [100_000, 100_000, 100_000, 110_000, 90_000]


@pytest.mark.parametrize(("behind", "followed"), [(True, True), (True, False), (False, True)])
def test_frame_that_was_not_alone_can_only_lower_the_own_delay(behind, followed):
    window = Window()
    window.answer(50_000, behind=behind, followed=followed)
    assert window.window.own_delay_us is None, "not yet measured"
    window.alone(100_000)
    for delay_us, own_us in ((110_000, 100_000), (100_001, 100_000), (99_999, 99_999)):
        window.answer(delay_us, behind=behind, followed=followed)
        assert window.window.own_delay_us == own_us


def test_equal_delay_of_a_frame_that_was_not_alone_is_not_counted_again():
    window = Window()
    for delay_us in (100_000, 110_000, 120_000):
        window.alone(delay_us)
    window.answer(100_000)
    window.alone(110_000)
    assert window.window.own_delay_us == 110_000


# --- wider -------------------------------------------------------------------------------------------------------


def test_window_doubles_while_no_frame_waits():
    """From 1 after two answers, from 2 after three that were behind others, from 4 after four, from 8 after eight."""
    window = Window(most=12)
    assert window.changes(1, 400_000, behind=False, followed=False) == []
    assert window.changes(1, 400_000, behind=False, followed=False) == [(1, 2)]
    assert window.changes(30, 400_000) == [(3, 4), (7, 8), (15, 11)]


def test_first_answers_at_the_very_start_of_the_clock_count():
    window = Window(now_us=0)
    window.alone(after_us=0)
    window.alone(after_us=0)
    assert window.frames == 2
    window.narrowed(after_us=0)
    assert window.widens_after(1_000_000), "twice the first pause"


@pytest.mark.parametrize(("own_us", "frames"), [
    (0, 1), (19_999, 1), (20_000, 2), (59_999, 2), (60_000, 3), (99_999, 3), (100_000, 4), (10_000_000, 12),
])  # fmt: skip
def test_width_is_one_more_for_each_interval_of_delay(own_us, frames):
    window = Window()
    for _ in range(2):
        window.alone(own_us)
    window.changes(30, own_us)
    assert window.frames == frames


@pytest.mark.parametrize(("computed_us", "frames"), [
    ((133_333, 133_333), 2),  # an average of 68.0 ms
    ((78_300, 78_300), 4), ((78_600, 78_600), 3),  # 0.51 times 78.4 ms is the interval
    ((133_333, 40_000), 4), ((133_340, 40_000), 3),  # 0.3 times 133.3 ms is the interval
])  # fmt: skip
def test_peer_slower_than_the_camera_gets_one_frame_for_each_time_that_it_computes(computed_us, frames):
    """The average weighs each answer with 0.3. Of 100 ms, 2.5 intervals of 40 ms are 4 frames, 2.4 of 41 ms are 3."""
    window = Window()
    window.alone(compute_us=computed_us[0])
    window.alone(compute_us=computed_us[1])
    for _ in range(40):
        window.answer(FAR_US, compute_us=round(window.window._compute_us))
    assert window.frames == frames


def test_average_of_the_computing_time_that_equals_the_interval_is_not_slower():
    """1 + (100 + 20) // 40 frames, not 1 + 100 // 40."""
    window = Window()
    for compute_us in (133_333 + 1 / 3, *([40_000] * 30)):
        window.answer(FAR_US, behind=window.frames > 1, followed=window.frames > 1, compute_us=compute_us)
    assert window.frames == FAR_FRAMES


def test_peer_of_half_the_delay_gets_three_frames():
    window = Window()
    for _ in range(60):
        window.answer(FAR_US, behind=window.frames > 1, followed=window.frames > 1, compute_us=50_000)
    assert window.frames == 1 + 2


def test_window_follows_a_shorter_link_down():
    window = two_in_flight(most=12)
    window.changes(10)
    assert window.frames == FAR_FRAMES
    for _ in range(4):
        window.answer(10_000)
    assert window.frames == 1


@pytest.mark.parametrize(("delay_us", "frames"), [(116_666, 4), (116_667, 2)])
def test_frames_that_wait_longer_than_a_sixth_of_the_delay_prevent_widening(delay_us, frames):
    window = two_in_flight(most=12)
    for _ in range(6):
        window.answer(delay_us, held_back=False)
    assert window.frames == frames


def test_one_frame_of_three_without_waiting_is_enough_to_widen():
    window = two_in_flight(most=12)
    for delay_us in (150_000, 100_000, 150_000):
        window.answer(delay_us, held_back=False)
    assert window.frames == 4


def test_only_frames_behind_others_show_that_a_wider_window_fits():
    window = two_in_flight(most=12)
    for _ in range(10):
        window.alone()
        window.answer(116_666, behind=False)
    assert window.frames == 2
    window.changes(2)
    assert window.frames == 2
    window.answer(FAR_US)
    assert window.frames == 4


# --- a queue -----------------------------------------------------------------------------------------------------


def queue(own_us, *delays_us, held_back=True, behind=True, followed=True):
    """Return True if these answers are a queue on a link of this delay, with one frame in flight at most."""
    window = Window(most=1)
    window.alone(own_us)
    full = [window.answer(one, gap_us=100_000, held_back=held_back, behind=behind, followed=followed)
            for one in delays_us]
    return any(full)


@pytest.mark.parametrize(("own_us", "delays_us", "expected"), [
    (100_000, (180_001, 180_001), True), (100_000, (180_000, 300_000), False), (100_000, (300_000, 180_000), False),
    (100_000, (300_000,), False), (100_000, (110_000, 180_001, 180_001), True),
    (100_000, (180_001, 110_000, 180_001), False),
    (100_000, (116_667, 116_667, 116_667), True), (100_000, (116_666, 116_667, 116_667), False),
    (100_000, (116_667, 116_666, 116_667), False), (100_000, (116_667, 116_667), False),
    (12_000, (17_001, 17_001, 17_001), True), (12_000, (17_000, 17_001, 17_001), False),
    (36_000, (42_001, 42_001, 42_001), True), (36_000, (42_001, 42_001, 42_000), False),
    (100_000, (116_000, 116_667, 116_667, 116_667), True),
])  # fmt: skip
def test_two_gross_waits_or_three_clear_ones_in_a_row_are_a_queue(own_us, delays_us, expected):
    """Gross: above 1.75 times the delay and 5 ms. Clear: above the delay and a sixth of it, or 5 ms."""
    assert queue(own_us, *delays_us) is expected


@pytest.mark.parametrize(("behind", "followed", "expected"), [
    (True, True, True), (True, False, True), (False, True, True), (False, False, False),
])  # fmt: skip
def test_frame_that_another_follows_can_wait_behind_it(behind, followed, expected):
    """Both directions may share the medium."""
    assert queue(100_000, 185_000, 185_000, behind=behind, followed=followed) is expected


def test_delay_before_any_measurement_is_not_a_queue():
    window = Window(most=1)
    assert [window.answer(900_000, gap_us=100_000, behind=False) for _ in range(4)] == [None] * 4
    assert [window.answer(900_000, gap_us=100_000) for _ in range(4)] == [None] * 4
    assert window.window.own_delay_us is None


@pytest.mark.parametrize("held", [0, 1, 2])
def test_queue_needs_one_frame_that_was_due_before_there_was_credit(held):
    """Delays are only jitter if the camera never waited."""
    window = Window(most=1)
    window.alone()
    full = [window.answer(185_000, gap_us=100_000, held_back=number < held) for number in range(2)]
    assert (full[1] is not None) == (held > 0)


def test_waits_count_once():
    window = Window(most=1)
    window.alone()
    full = [window.answer(185_000, gap_us=100_000) is not None for _ in range(4)]
    assert full == [False, True, False, True]


@pytest.mark.parametrize(("gaps_us", "computed_us", "full"), [
    ((42_000, 42_000), (0, 0), False), ((42_000, 42_001), (0, 0), True), ((84_000, 0), (0, 0), False),
    ((100_000, 100_000), (70_000, 70_000), True), ((100_000, 100_000), (70_000, 70_001), False),
    ((100_000, 100_000), (0, 140_001), False), ((42_000, 42_000), (42_000, 42_000), False),
])  # fmt: skip
def test_link_is_full_if_neither_the_camera_nor_the_peer_sets_the_pace(gaps_us, computed_us, full):
    """1.05 intervals a frame keep up with the camera. 0.7 of the time spent computing is the peer's own pace."""
    window = Window(most=1)
    window.alone()
    window.answer(300_000, gap_us=gaps_us[0], compute_us=computed_us[0])
    assert (window.answer(300_000, gap_us=gaps_us[1], compute_us=computed_us[1]) is not None) == full


def test_frames_that_a_newer_one_overtook_were_carried_too():
    window = Window(most=1)
    window.alone()
    window.answer(300_000, gap_us=120_000, frames=3)
    assert window.answer(300_000, gap_us=90_000, frames=2) is None, "210 ms for 5 frames keep up"
    window.answer(300_000, gap_us=120_000, frames=3)
    assert window.answer(300_000, gap_us=90_001, frames=2) is not None


def test_capacity_is_what_was_carried_while_frames_waited_and_the_least_wait():
    window = Window(most=1)
    window.alone()
    window.answer(330_000, gap_us=90_000, size_bytes=11_000)
    full = window.answer(310_000, gap_us=110_000, frames=2, size_bytes=7_000)
    assert full == LinkCapacity(125_000.0, 310_000)


@pytest.mark.parametrize(("delays_us", "frames"), [
    ((120_000,) * 3, 3), ((160_000,) * 3, 2), ((185_000,) * 2, 2), ((185_000, 390_000), 2), ((390_000, 185_000), 2),
    ((260_000,) * 2, 2), ((270_000,) * 2, 1), ((900_000,) * 2, 1),
])  # fmt: skip
def test_queue_narrows_the_window_to_what_did_not_wait(delays_us, frames):
    """Four frames times the own delay over the least wait, at least one."""
    window = two_in_flight(most=FAR_FRAMES)
    window.changes(3)
    assert window.frames == FAR_FRAMES
    for delay_us in delays_us:
        window.answer(delay_us)
    assert window.frames == frames


# --- the pause after a queue -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("answers", "held_us", "paused_us"), [
    (12, 1_000_000, 500_000), (11, 1_000_000, 1_000_000), (12, 999_999, 1_000_000),
    (11, 3_000_000, 1_000_000), (40, 900_000, 1_000_000),
])  # fmt: skip
def test_pause_stays_short_only_if_the_window_held_for_a_second_and_for_twelve_answers(answers, held_us, paused_us):
    """Otherwise the width is the likely cause of the queue."""
    window = two_in_flight()
    until_us = window.now_us + held_us
    for left in reversed(range(answers)):
        last_us = until_us - window.now_us if left == 0 else 1_000
        if left > 1:
            window.alone(after_us=last_us)
        else:
            window.answer(220_000, after_us=last_us)
    assert window.frames == 1
    assert window.widens_after(paused_us)


def test_pause_doubles_with_each_queue_up_to_four_seconds():
    window = two_in_flight()
    for pause_us in (1_000_000, 2_000_000, 4_000_000, 4_000_000):
        window.narrowed()
        assert window.widens_after(pause_us)


def test_queue_that_drains_within_a_pause_is_of_the_attempt_before_it():
    """The pause begins again, and does not double. A link that has become longer keeps its frames for as long."""
    window = two_in_flight()
    window.narrowed()
    for _ in range(4):
        window.answer(10 * FAR_US)
    assert window.widens_after(1_000_000)
    window.narrowed()
    assert window.widens_after(2_000_000), "a new attempt"


def test_pause_is_short_again_after_a_width_that_held():
    window = two_in_flight()
    window.narrowed()
    assert window.widens_after(1_000_000)
    for _ in range(12):
        window.alone(after_us=100_000)
    window.narrowed()
    assert window.widens_after(500_000)


def test_window_widens_by_one_after_a_queue():
    window = two_in_flight(delay_us=400_000, most=12)
    for _ in range(2):
        window.answer(4_000_000)
    assert window.frames == 1
    window.pause_us(400_000)
    assert window.frames == 2
    assert window.changes(11, 400_000) == [(3, 3), (6, 4), (10, 5)]


def test_queue_at_the_least_width_costs_no_pause():
    """One frame in flight: the width is not the cause, and nothing was tried in vain."""
    window = Window()
    window.alone()
    window.window.on_timeout(window.now_us)
    for _ in range(2):
        window.answer(GROSS_US, after_us=10_000)
    assert window.pause_us() == FAR_US - 20_000, "only what the timeout costs"
    assert window.frames == 2
    assert window.changes(3) == [(3, 4)], "it still doubles"


# --- a link whose capacity is known ------------------------------------------------------------------------------

OWN_US = 200_000
"""A frame of 50 kB alone at 250 kB/s."""


def thin_window(own_us=OWN_US, size_bytes=50_000, rates=(250_000, 250_000), *, between=False):
    """Return a window after one attempt for each rate in bytes/s. Each attempt carries two frames in unequal times."""
    window = Window(most=12)
    for number, rate in enumerate(rates):
        if window.frames == 1 and number == 0:
            window.alone(own_us, size_bytes=size_bytes)
            window.alone(own_us, size_bytes=size_bytes)
        else:
            window.pause_us(own_us, size_bytes=size_bytes)
        assert window.frames == 2
        took_us = 2 * size_bytes * 1e6 / rate
        window.answer(10 * own_us, gap_us=took_us * 0.3, size_bytes=size_bytes)
        window.answer(10 * own_us, gap_us=took_us * 0.7, size_bytes=size_bytes)
        assert window.frames == 1
    return window


PAUSE_US = 2_000_000
"""After the second attempt."""
THIN_US = 30_000_000
"""For which a capacity is known that two attempts measured."""


def test_known_capacity_bounds_the_window_for_half_a_minute():
    assert thin_window().widens_after(THIN_US, OWN_US, size_bytes=50_000)


@pytest.mark.parametrize(("rates", "known"), [
    ((250_000,), False), ((250_000, 250_000), True), ((250_000, 287_000), True), ((287_000, 250_000), True),
    ((250_000, 288_000), False), ((288_000, 250_000), False),
])  # fmt: skip
def test_capacity_is_known_after_two_attempts_that_agree_within_15_percent(rates, known):
    window = thin_window(rates=rates)
    pause_us = PAUSE_US if len(rates) == 2 else PAUSE_US // 2
    assert window.pause_us(OWN_US, size_bytes=50_000) == (THIN_US if known else pause_us)


def test_attempt_that_the_link_keeps_up_with_makes_its_capacity_unknown():
    """Or that its peer keeps busy: the next attempt has nothing to agree with."""
    window = thin_window(rates=(250_000,))
    window.pause_us(OWN_US, size_bytes=50_000)
    window.narrowed(size_bytes=50_000, gap_us=200_000, compute_us=150_000)
    window.pause_us(OWN_US, size_bytes=50_000)
    window.narrowed(size_bytes=50_000, gap_us=200_000)
    assert window.pause_us(OWN_US, size_bytes=50_000) == 4_000_000


@pytest.mark.parametrize(("rates", "own_us", "known"), [
    # 0.8 of the former 200 ms of a frame alone
    ((250_000, 250_000), 160_000, True), ((250_000, 250_000), 159_999, False),
    # 0.6 of the 300 ms of a frame at 166,667 bytes/s
    ((50_000 / 0.3, 50_000 / 0.3), 180_000, True), ((50_000 / 0.3, 50_000 / 0.3), 179_998, False),
])  # fmt: skip
def test_capacity_is_forgotten_when_a_frame_alone_is_much_faster(rates, own_us, known):
    window = thin_window(rates=rates)
    for _ in range(3):
        window.alone(own_us, size_bytes=50_000)
    until_us = window.now_us + 10_000_000
    while window.now_us < until_us:
        window.alone(own_us, size_bytes=50_000, after_us=100_000)
    assert (window.frames == 1) == known


def test_capacity_that_was_forgotten_does_not_return():
    window = thin_window()
    window.now_us += PAUSE_US
    for delay_us in (100_000, 100_000, OWN_US, OWN_US, OWN_US):
        window.alone(delay_us, size_bytes=50_000)
    assert window.frames == 2
    assert window.changes(3, OWN_US, size_bytes=50_000) == [(3, 3)]


@pytest.mark.parametrize(("size_bytes", "bounded"), [(20_000, True), (19_999, False)])
def test_capacity_bounds_the_window_only_for_frames_that_occupy_the_link_for_two_intervals(size_bytes, bounded):
    """80 ms at 250 kB/s; behind a smaller frame the next one waits briefly."""
    window = thin_window(own_us=80_000, size_bytes=size_bytes)
    assert window.pause_us(80_000, size_bytes=size_bytes) == (THIN_US if bounded else PAUSE_US)


@pytest.mark.parametrize(("own_us", "frames"), [(200_000, 1), (299_000, 1), (301_000, 2), (499_000, 2), (501_000, 3)])
def test_window_is_the_number_of_frames_that_the_link_carries_at_once(own_us, frames):
    """Frames of 200 ms at the known capacity, on a link of this delay."""
    window = thin_window(own_us=own_us)
    until_us = window.now_us + 20_000_000
    while window.now_us < until_us:
        behind = window.frames > 1
        window.answer(own_us, behind=behind, followed=behind, size_bytes=50_000, after_us=50_000)
    assert window.frames == frames


@pytest.mark.parametrize("overtaken", [0, 1])
@pytest.mark.parametrize(("size_bytes", "frames"), [(17_200, 2), (17_420, 1)])
def test_size_of_a_frame_is_averaged_with_a_weight_of_three_tenths(size_bytes, frames, overtaken):
    """Two answers after 50 kB, 0.49 times that and 0.51 times theirs. Of 33.3 kB the link carries one and a half."""
    window = thin_window()
    for after_us in (0, PAUSE_US):
        window.alone(OWN_US, size_bytes=size_bytes, frames=1 + overtaken, after_us=after_us)
    assert window.frames == frames


def test_size_of_the_first_frame_counts_whole():
    """No average with a size of zero: else the link would seem to carry more of them at once."""
    window = Window(most=12)
    window.window._thin = thin_window().window._thin
    for after_us in (0, 1_000):
        window.alone(OWN_US, size_bytes=50_000, after_us=after_us)
    assert window.frames == 1


# --- timeouts ----------------------------------------------------------------------------------------------------


def test_timeout_narrows_to_one_frame_until_those_in_flight_have_left_the_link():
    window = two_in_flight(most=12)
    window.changes(3)
    window.window.on_timeout(window.now_us)
    assert window.frames == 1
    assert window.pause_us() == FAR_US
    assert window.frames == 2
    assert window.changes(3) == [(3, 4)], "it still doubles"


def test_timeout_does_not_shorten_a_pause():
    window = two_in_flight()
    window.narrowed()
    window.window.on_timeout(window.now_us)
    assert window.pause_us() == 1_000_000


def test_timeout_before_the_first_answer_costs_no_time():
    window = Window()
    window.window.on_timeout(window.now_us)
    window.alone(after_us=0)
    window.alone(after_us=0)
    assert window.frames == 2


@pytest.mark.parametrize(("own_us", "jitter_us", "most_us"), [
    (12_000, 0, 17_000), (12_000, 1_000, 18_000), (60_000, 0, 70_000), (60_000, 2_500, 72_500),
])  # fmt: skip
def test_delay_of_a_link_without_a_queue_is_its_own_delay_and_the_jitter(own_us, jitter_us, most_us):
    window = Window()
    window.alone(own_us)
    assert window.window.is_floor(most_us, jitter_us) is True
    assert window.window.is_floor(most_us + 1, jitter_us) is False


def test_no_delay_is_that_of_a_link_without_a_queue_before_the_first_measurement():
    assert CongestionWindow(INTERVAL_US, 12).is_floor(0, 0) is False
