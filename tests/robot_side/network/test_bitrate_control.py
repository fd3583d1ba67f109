"""The control of the encoding, image by image: when the bytes fall and rise, and which quality and size they give."""

import pytest

from sightline.robot_side.network.bitrate_control import (
    LEAST_QUALITY_PERCENT,
    PICTURE_US,
    SCALES_PERCENT,
    BitrateControl,
    EncodingTarget,
)
from sightline.robot_side.network.congestion_window import LinkCapacity

FULL = EncodingTarget(100, 100)
BYTES = 40_000
QUICK_US = 10_000
"""The delay of a free link."""
START_US = 10_000_000


class Control:
    """A control, its clock, and a camera whose images have any size that a test wants."""

    def __init__(self, size_bytes=BYTES, images=3):
        self.control = BitrateControl()
        self.now_us = START_US
        self.images(size_bytes, images)

    def images(self, size_bytes, count=1):
        for _ in range(count):
            self.control.on_sent(size_bytes, self.now_us)

    def delay(self, delay_us, after_us=1_000):
        self.now_us += after_us
        self.control.on_delay(delay_us, self.now_us)

    def full(self, bytes_per_s, delay_us=60_000):
        self.control.on_full(LinkCapacity(bytes_per_s, delay_us), self.now_us)

    def budget_bytes(self):
        return self.control._budget_bytes

    @property
    def target(self):
        return self.control.target


def test_constants_that_others_rely_on():
    assert (PICTURE_US, SCALES_PERCENT, LEAST_QUALITY_PERCENT) == (28_000, (100, 50), 25)
    assert BitrateControl().target == EncodingTarget() == FULL


# --- a full link -------------------------------------------------------------------------------------------------


def test_full_link_gets_images_that_it_carries_in_28_ms():
    """1 MB/s: 28,000 bytes, seven tenths of the present 40,000."""
    control = Control()
    control.full(1e6)
    assert control.budget_bytes() == 28_000
    control.images(BYTES)
    assert control.target == (70, 100)


@pytest.mark.parametrize(("bytes_per_s", "budget"), [
    (1e6, 28_000), (1e5, 2_800), (72_000, 2_016), (71_000, 2_000), (10, 2_000), (0, 2_000), (BYTES / 0.028, None),
    (1e7, None),
])  # fmt: skip
def test_budget_is_at_least_2_kilobytes_and_never_above_the_present_size(bytes_per_s, budget):
    control = Control()
    control.full(bytes_per_s)
    assert control.budget_bytes() == (None if budget is None else pytest.approx(budget))


def test_budget_falls_with_each_measurement_and_does_not_rise_with_one():
    control = Control()
    for bytes_per_s, budget in ((1e6, 28_000), (1.2e6, 28_000), (5e5, 14_000)):
        control.full(bytes_per_s)
        assert control.budget_bytes() == pytest.approx(budget)


def test_full_link_before_the_first_sizes_changes_nothing():
    control = Control(images=0)
    control.full(1e6)
    assert control.budget_bytes() is None


# --- delays ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("delay_us", "budget"), [(QUICK_US + 40_000, None), (QUICK_US + 40_001, 0.8 * BYTES)])
def test_delay_40_ms_above_the_least_recent_one_cuts_a_fifth(delay_us, budget):
    control = Control()
    control.delay(QUICK_US)
    control.delay(delay_us)
    assert control.budget_bytes() == budget


@pytest.mark.parametrize(("size_bytes", "count"), [(BYTES, 2), (0, 9)])
def test_delay_before_a_size_is_known_cuts_nothing(size_bytes, count):
    """The first two images were captured before the target changed."""
    control = Control(size_bytes, count)
    control.delay(QUICK_US)
    control.delay(900_000)
    assert control.budget_bytes() is None and control.target == FULL


@pytest.mark.parametrize(("delay_us", "pause_us"), [(100_000, 250_000), (250_000, 250_000), (400_000, 400_000)])
def test_next_cut_comes_after_a_quarter_of_a_second_or_the_delay(delay_us, pause_us):
    control = Control()
    control.delay(QUICK_US)
    control.delay(delay_us)
    cut_us = control.now_us
    control.delay(9_000_000, after_us=pause_us - 1)
    assert control.budget_bytes() == pytest.approx(0.8 * BYTES)
    control.delay(9_000_000, after_us=1)
    assert control.now_us == cut_us + pause_us
    assert control.budget_bytes() == pytest.approx(0.64 * BYTES)


@pytest.mark.parametrize(("excess_us", "step"), [(0, 1_500), (19_999, 1_500), (20_000, 0), (40_000, 0)])
def test_free_link_raises_the_budget_by_1500_bytes(excess_us, step):
    control = Control()
    control.delay(QUICK_US)
    control.full(1e6)
    control.delay(QUICK_US + excess_us, after_us=250_000)
    assert control.budget_bytes() == pytest.approx(28_000 + step)


def test_budget_rises_each_quarter_of_a_second_after_a_measurement():
    control = Control()
    control.delay(QUICK_US)
    control.full(1e6)
    found = []
    for after_us in (249_999, 1, 249_999, 1, 250_000):
        control.delay(QUICK_US, after_us)
        found.append(round(control.budget_bytes()))
    assert found == [28_000, 29_500, 29_500, 31_000, 32_500]


def test_without_a_budget_a_free_link_sets_none():
    control = Control()
    for _ in range(5):
        control.delay(QUICK_US, after_us=300_000)
    assert control.budget_bytes() is None


def excess_cuts(control, delay_us):
    """Return True if this delay counts as too long now."""
    before = control.control._current()
    control.delay(delay_us)
    return control.control._current() < before


@pytest.mark.parametrize("start_us", [0, START_US])
@pytest.mark.parametrize(("middle_us", "cuts"), [(4_999_999, True), (5_000_000, False)])
def test_least_delay_is_forgotten_when_the_second_period_after_it_begins(start_us, middle_us, cuts):
    """A period has five seconds and begins with the first delay after the one before it."""
    control = Control()
    for at_us, delay_us in ((0, QUICK_US), (middle_us, 45_000), (middle_us + 5_000_000, 60_000)):
        control.now_us = start_us
        control.delay(delay_us, after_us=at_us)
    assert (control.budget_bytes() is not None) == cuts


def test_first_delays_at_the_very_start_of_the_clock_count():
    control = Control()
    control.now_us = 0
    control.delay(QUICK_US, after_us=0)
    control.delay(90_000, after_us=0)
    assert control.budget_bytes() == pytest.approx(0.8 * BYTES)


def test_least_delay_of_either_period_counts():
    control = Control()
    control.delay(60_000)
    control.delay(QUICK_US, after_us=5_000_000)
    control.delay(60_000)
    assert control.budget_bytes() == pytest.approx(0.8 * BYTES)


def test_shorter_delay_is_the_new_least_one():
    control = Control()
    for delay_us in (60_000, 15_000, 30_000, QUICK_US, 50_000):
        control.delay(delay_us)
    assert control.budget_bytes() is None
    control.delay(50_001)
    assert control.budget_bytes() == pytest.approx(0.8 * BYTES)


# --- overdue answers ---------------------------------------------------------------------------------------------


def test_overdue_answers_halve_the_bytes_and_the_budget_then_rests():
    control = Control()
    control.delay(QUICK_US)
    control.control.on_overdue(control.now_us)
    assert control.budget_bytes() == pytest.approx(BYTES / 2)
    control.control.on_overdue(control.now_us)
    assert control.budget_bytes() == pytest.approx(BYTES / 4)
    control.delay(QUICK_US, after_us=249_999)
    assert control.budget_bytes() == pytest.approx(BYTES / 4)
    control.delay(QUICK_US, after_us=1)
    assert control.budget_bytes() == pytest.approx(BYTES / 4 + 1_500)


def test_cut_is_of_the_smaller_one_of_size_and_budget():
    control = Control()
    control.full(1e6)
    control.control.on_overdue(control.now_us)
    assert control.budget_bytes() == pytest.approx(14_000), "the budget is below the size"
    control = Control()
    control.full(1e6)
    control.images(20_000, 60)
    control.full(1e6)
    control.control.on_overdue(control.now_us)
    assert control.budget_bytes() < 10_001, "the size is below the budget"


def test_overdue_after_a_new_target_cuts_the_budget():
    """The sizes of the new encoding are not known yet."""
    control = Control()
    control.full(1e6)
    control.images(BYTES)
    assert control.target == (70, 100)
    control.control.on_overdue(control.now_us)
    assert control.budget_bytes() == pytest.approx(14_000)


# --- a cut in vain -----------------------------------------------------------------------------------------------


def after_cut(*delays_us, size_bytes=BYTES // 2, images=5):
    """A link carries 40 kB at 1 MB/s and takes 60 ms; after the cut the images have 20 kB, and these delays."""
    control = Control()
    control.delay(QUICK_US)
    control.full(1e6, delay_us=60_000)
    control.control._frames, control.control._bytes = 0, 0.0  # as after a new target
    control.images(size_bytes, images)
    for delay_us in delays_us:
        control.delay(delay_us)
    return control


@pytest.mark.parametrize(("least_us", "undone"), [(43_000, False), (43_001, True)])
def test_cut_that_did_not_shorten_the_delay_is_undone(least_us, undone):
    """20 ms were spared. The least of three delays and those are above 1.05 times 60 ms: the link became longer."""
    control = after_cut(90_000, least_us, 80_000)
    assert (control.budget_bytes() > 35_000) == undone
    assert (control.control._made is None)


def test_undone_cut_restores_the_size_and_makes_the_longer_delay_normal():
    control = after_cut(90_000, 70_000, 80_000)
    assert control.budget_bytes() == BYTES
    control.now_us += 300_000
    assert not excess_cuts(control, 110_000)
    assert excess_cuts(control, 110_001)


def test_two_delays_do_not_show_whether_a_cut_helped():
    control = after_cut(90_000, 90_000)
    assert control.budget_bytes() == pytest.approx(28_000)
    control.delay(90_000)
    assert control.budget_bytes() == BYTES


def test_delays_before_three_images_of_the_new_size_do_not_count():
    control = after_cut(90_000, 90_000, 90_000, images=4)
    assert control.budget_bytes() == pytest.approx(28_000)
    control.images(BYTES // 2)
    for _ in range(2):
        control.delay(90_000)
    assert control.budget_bytes() == pytest.approx(28_000)
    control.delay(90_000)
    assert control.budget_bytes() == BYTES


def test_images_of_unknown_size_do_not_show_whether_a_cut_helped():
    assert after_cut(90_000, 90_000, 90_000, size_bytes=0).budget_bytes() == pytest.approx(28_000)


def test_cut_is_checked_once():
    control = after_cut(20_000, 20_000, 20_000)
    for _ in range(6):
        control.delay(45_000)
    assert control.budget_bytes() == pytest.approx(28_000)


def test_delays_of_an_earlier_cut_do_not_count_for_the_next():
    control = after_cut(20_000, 20_000)
    control.full(5e5, delay_us=60_000)
    control.delay(90_000)
    control.delay(90_000)
    assert control.budget_bytes() == pytest.approx(14_000)
    control.delay(90_000)
    assert control.budget_bytes() == pytest.approx(20_000)


def test_cut_after_a_delay_is_checked_with_the_excess_of_each_byte():
    """60 ms too long for 40 kB: 1.5 us a byte. 8 kB less spare 12 ms, so that 61.5 ms are not in vain and 62 are."""
    for least_us, undone in ((61_500, False), (61_501, True)):
        control = Control()
        control.delay(QUICK_US)
        control.delay(70_000)
        assert control.budget_bytes() == pytest.approx(32_000)
        control.control._frames, control.control._bytes = 0, 0.0
        control.images(32_000, 5)
        for delay_us in (least_us, 90_000, 90_000):
            control.delay(delay_us)
        assert (control.budget_bytes() == BYTES) == undone


def test_cut_after_overdue_answers_is_not_checked():
    control = Control()
    control.delay(QUICK_US)
    control.control.on_overdue(control.now_us)
    control.control._frames, control.control._bytes = 0, 0.0
    control.images(BYTES // 2, 5)
    for _ in range(3):
        control.delay(900_000)
    assert control.budget_bytes() == pytest.approx(20_000)


# --- quality and size --------------------------------------------------------------------------------------------


def chosen(budget_bytes, target, size_bytes=10_000, *, images=3, now_us=START_US):
    """Return the target after the images of one size, with a budget and an earlier target."""
    control = BitrateControl()
    control._budget_bytes, control.target = budget_bytes, EncodingTarget(*target)
    for _ in range(images):
        control.on_sent(size_bytes, now_us)
    return tuple(control.target), control._budget_bytes


@pytest.mark.parametrize(("budget", "target", "expected"), [
    (8_000, (100, 100), (80, 100)), (8_000, (50, 100), (40, 100)), (12_000, (50, 100), (60, 100)),
    (8_999, (100, 100), (90, 100)), (9_001, (100, 100), (100, 100)), (10_999, (60, 100), (60, 100)),
    (11_000, (60, 100), (66, 100)), (9_000, (100, 100), (90, 100)),
    (11_001, (60, 100), (66, 100)), (20_000, (60, 100), (100, 100)), (3_000, (60, 100), (25, 100)),
    (8_000, (26, 100), (25, 100)), (12_000, (50, 50), (60, 50)),
    # from the least quality to half the size
    (7_999, (25, 100), (60, 50)), (8_000, (25, 100), (25, 100)), (8_500, (25, 100), (25, 100)),
    (12_000, (25, 100), (30, 100)), (3_000, (25, 50), (25, 50)),
    # and back to the full size
    (13_001, (100, 50), (40, 100)), (13_000, (100, 50), (100, 50)), (9_000, (100, 50), (90, 50)),
    (13_001, (99, 50), (100, 50)),
])  # fmt: skip
def test_quality_follows_the_share_of_the_budget_in_the_size(budget, target, expected):
    """Images of 10 kB. Below 0.9 and above 1.1 of them the quality changes, within 25 and 100 percent."""
    assert chosen(budget, target) == (expected, budget)


@pytest.mark.parametrize(("budget", "left"), [(15_000, 15_000), (15_001, None)])
def test_budget_ends_half_above_the_full_size(budget, left):
    assert chosen(budget, (100, 100)) == ((100, 100), left)
    assert chosen(budget, (100, 50))[1] == budget, "not at half the size"
    assert chosen(budget, (90, 100))[1] == budget, "nor at less quality"


def test_third_image_after_a_new_target_decides():
    """Two were captured before it."""
    assert chosen(8_000, (100, 100), images=2)[0] == (100, 100)
    assert chosen(8_000, (100, 100), images=3)[0] == (80, 100)
    control = BitrateControl()
    control._budget_bytes = 8_000
    found = []
    for _ in range(7):
        control.on_sent(10_000, START_US)
        found.append(control.target.quality_percent)
    assert found == [100, 100, 80, 80, 80, 64, 64]


def test_size_of_an_image_is_averaged_with_a_weight_of_three_tenths():
    """40 kB and then 20 kB: 34 kB, of which 32 kB are 94 percent; then 29.8 kB."""
    control = Control()
    control.control._budget_bytes = 37_000.0
    control.images(20_000)
    assert control.control._bytes == pytest.approx(34_000)
    control.images(20_000)
    assert control.control._bytes == pytest.approx(29_800)
    control.images(0)
    assert control.control._bytes == pytest.approx(29_800), "an unknown size"


def test_size_changes_at_most_each_three_seconds():
    """A new size restarts the pipeline of the vision service."""
    control = BitrateControl()
    control._budget_bytes = 5_000
    control.target = EncodingTarget(25, 100)
    for _ in range(3):
        control.on_sent(10_000, 0)
    assert control.target == (60, 50), "the first at any time"
    for now_us, expected in ((1_000_000, (100, 50)), (2_999_999, (100, 50)), (3_000_000, (40, 100))):
        control._budget_bytes, control.target = 20_000, EncodingTarget(100, 50)
        for _ in range(3):
            control.on_sent(10_000, now_us)
        assert control.target == expected
    control._budget_bytes, control.target = 5_000, EncodingTarget(25, 100)
    for _ in range(3):
        control.on_sent(10_000, 5_999_999)
    assert control.target == (25, 100), "three seconds from the last change"
