"""Teleop's keys and the time that they count as held, its speeds and ramp, a gamepad's buttons and sticks."""

import itertools

import pytest

from sightline.operator_side.teleop.control import (
    LEGACY,
    LONGEST_HOLD_US,
    WASD,
    Hold,
    Speeds,
    SpeedUp,
    layout_of,
    split_keys,
)
from sightline.operator_side.teleop.gamepad import (
    ABS_RX,
    ABS_X,
    ABS_Y,
    BTN_EAST,
    BTN_SOUTH,
    BTN_TL,
    BTN_TR,
    Pad,
    PadKey,
)
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import STILL, State, Status, Twist

# --- keys ------------------------------------------------------------------------------------------------------------


def test_keys_of_one_read_are_split():
    assert split_keys("ii\x1b[A\x1bOBq\x1b") == ["i", "i", "\x1b[A", "\x1b[B", "q", "\x1b"]


def test_legacy_layout_has_the_keys_of_the_legacy_programs():
    assert [LEGACY.moves[key] for key in "uiojlm,."] == [
        (1, 1), (1, 0), (1, -1), (0, 1), (0, -1), (-1, -1), (-1, 0), (-1, 1),
    ]  # fmt: skip
    assert LEGACY.stops[:2] == ("k", " ")


def test_default_layout_has_the_keys_of_games():
    assert [WASD.moves[key] for key in "wsad"] == [(1, 0), (-1, 0), (0, 1), (0, -1)]
    for layout in (WASD, LEGACY):
        assert [layout.moves[f"\x1b[{key}"] for key in "ABDC"] == [(1, 0), (-1, 0), (0, 1), (0, -1)]
        assert " " in layout.stops
        for keys in (layout.moves, layout.speeds, layout.stops):
            assert not {"q", "\t"} & set(keys)


def test_unknown_layout_is_rejected():
    assert layout_of("legacy") is LEGACY
    with pytest.raises(ConfigError, match="unknown --keys 'dvorak'; expected wasd or legacy"):
        layout_of("dvorak")


@pytest.mark.parametrize("delay_ms", [150, 250, 500, 660])
@pytest.mark.parametrize("repeat_ms", [15, 25, 33, 50, 100])
def test_a_held_key_is_held_throughout_once_its_terminal_is_known(delay_ms, repeat_ms):
    hold, now_us = Hold(), 0
    for attempt in range(3):
        now_us += 5_000_000
        hold.press("i", now_us)
        gaps = [delay_ms] + [repeat_ms] * 30
        for gap_ms in gaps:
            still_held = hold.is_held(now_us + gap_ms * 1000 - 1)
            assert still_held or (attempt == 0 and gap_ms == delay_ms), f"{gap_ms} ms in attempt {attempt}"
            now_us += gap_ms * 1000
            assert not hold.press("i", now_us)
        assert not hold.is_held(now_us + LONGEST_HOLD_US + 1)


def test_tap_ends_after_its_time_and_changes_no_rate():
    hold = Hold()
    before = hold.delay_us, hold.interval_us
    for tap in range(10):
        hold.press("i", 1_000_000 + tap * 400_000)
    assert (hold.delay_us, hold.interval_us) == before
    assert not hold.is_held(1_000_000 + 9 * 400_000 + 900_001)


def test_only_a_press_after_a_while_without_any_is_fresh():
    hold = Hold()
    assert hold.press("i", 10_000_000)
    assert not hold.press("i", 10_500_000), "its first repeat"
    assert not hold.press("i", 10_533_000)
    assert not hold.press("u", 10_600_000), "the next key of the same drive"
    assert not hold.press("u", 10_800_000), "a stutter"
    assert hold.press("u", 12_900_000)


def test_repeats_of_one_read_count_once():
    hold = Hold()
    hold.press("i", 1_000)
    for _ in range(5):
        assert not hold.press("i", 1_000)
    assert hold.interval_us == Hold().interval_us


# --- speeds and ramp -------------------------------------------------------------------------------------------------


def test_speeds_change_by_ten_percent_and_stay_within_the_robots():
    speeds = Speeds(0.2, 1.0)
    speeds.change(1, 1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (pytest.approx(0.22), pytest.approx(1.1))
    speeds.change(-1, 0)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (pytest.approx(0.2), pytest.approx(1.1))
    speeds.limit(Status(state=State.HOLD, reason="", max_linear_mps=0.12, max_angular_rad_s=1.2))
    for _ in range(20):
        speeds.change(1, 1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (0.12, 1.2)
    for _ in range(200):
        speeds.change(-1, -1)
    assert (speeds.linear_mps, speeds.angular_rad_s) == (0.02, 0.1)
    slow = Speeds(0.2, 1.0)
    slow.limit(Status(state=State.HOLD, reason="", max_linear_mps=0.01, max_angular_rad_s=0.05))
    assert (slow.linear_mps, slow.angular_rad_s) == (0.01, 0.05), "a robot slower than the least keeps its limit"


def test_speeding_up_is_a_ramp_and_slowing_down_is_immediate():
    ramp, now_us = SpeedUp(), 0
    goal = Twist(linear_mps=0.5, angular_rad_s=-2.0)
    seen = []
    for _ in range(30):
        now_us += 30_000
        seen.append(ramp.step(goal, now_us))
    assert 0 < seen[0].linear_mps < 0.05 and 0 > seen[0].angular_rad_s > -0.5
    steps = [after.linear_mps - before.linear_mps for before, after in itertools.pairwise(seen)]
    assert max(steps) <= 0.8 * 0.03 + 1e-9 and seen[-1] == goal
    lower = Twist(linear_mps=0.1, angular_rad_s=0.0)
    assert ramp.step(lower, now_us + 1) == lower
    back = ramp.step(Twist(linear_mps=-0.5, angular_rad_s=0.0), now_us + 30_001)
    assert -0.03 < back.linear_mps < 0, "the other way begins at zero"
    assert ramp.step(STILL, now_us + 30_002) == STILL


# --- a gamepad -------------------------------------------------------------------------------------------------------

RANGES = {ABS_X: (0, 255), ABS_Y: (-32768, 32767), ABS_RX: (-100, 100)}


@pytest.mark.parametrize(("events", "shares"), [
    ([], None), ([(3, ABS_Y, -32768)], None),
    ([(1, BTN_TL, 1)], (0.0, 0.0)), ([(1, BTN_TR, 1), (3, ABS_Y, -32768)], (1.0, 0.0)),
    ([(1, BTN_TR, 1), (3, ABS_Y, 32767)], (-1.0, 0.0)), ([(1, BTN_TL, 1), (3, ABS_X, 0)], (0.0, 1.0)),
    ([(1, BTN_TL, 1), (3, ABS_RX, 100)], (0.0, -1.0)), ([(1, BTN_TL, 1), (3, ABS_X, 132)], (0.0, 0.0)),
    ([(1, BTN_TL, 1), (3, ABS_RX, 56)], (0.0, -0.5)), ([(1, BTN_TL, 1), (3, 9, 100)], (0.0, 0.0)),
    ([(1, BTN_TL, 1), (1, BTN_TR, 1), (1, BTN_TL, 0)], (0.0, 0.0)), ([(1, BTN_TL, 1), (1, BTN_TL, 0)], None),
    ([(1, BTN_TL, 1), (3, ABS_Y, -99999)], (1.0, 0.0)),
])  # fmt: skip
def test_a_gamepad_drives_while_its_shoulder_button_is_held(events, shares):
    pad = Pad(RANGES)
    for event in events:
        pad.on_event(*event)
    assert pad.shares == (shares if shares is None else pytest.approx(shares, abs=0.01))


def test_gamepad_stop_needs_a_new_press_of_the_shoulder_button():
    pad = Pad(RANGES)
    pad.on_event(1, BTN_TL, 1)
    assert pad.on_event(1, BTN_EAST, 1) is PadKey.STOP and pad.shares is None
    assert pad.on_event(1, BTN_EAST, 0) is None and pad.shares is None
    pad.on_event(1, BTN_TL, 0)
    pad.on_event(1, BTN_TL, 1)
    assert pad.shares == (0.0, 0.0)
    assert pad.on_event(1, BTN_SOUTH, 1) is PadKey.HAND_OVER
