"""Every number and branch of the battery's levels, and what they do to the gate: just inside, at it, just outside."""

import math

import pytest
from pydantic import ValidationError

from sightline.robot_side.safety.battery import BatteryLevel, BatteryLimits, BatteryMonitor

OK, LOW, SILENT, EMPTY = BatteryLevel.OK, BatteryLevel.LOW, BatteryLevel.SILENT, BatteryLevel.EMPTY
# Binary fractions, so that "just" is just.
CONFIG = BatteryLimits(low_battery_v=7.0, empty_battery_v=6.5, battery_hysteresis_v=0.25)
JUST_V = 2.0**-20


def after(*readings_v, config=CONFIG, t_us=0):
    monitor = BatteryMonitor(config)
    for volts in readings_v:
        monitor.see(volts, t_us)
    return monitor


@pytest.mark.parametrize(
    ("readings_v", "level"),
    [
        ([8.4], OK),
        ([7.0], OK),
        ([7.0 - JUST_V], LOW),
        ([6.5], LOW),
        ([6.5 - JUST_V], EMPTY),
        ([0.0], EMPTY),
        ([-1.0], EMPTY),
        ([6.9, 7.25 - JUST_V], LOW),
        ([6.9, 7.25], OK),
        ([6.9, 7.25, 7.0], OK),
        ([6.9, 6.5], LOW),
        ([6.9, 6.5 - JUST_V], EMPTY),
        ([6.4, 6.75 - JUST_V], EMPTY),
        ([6.4, 6.75], LOW),
        ([6.4, 6.75, 6.5], LOW),
        ([6.4, 7.25 - JUST_V], LOW),
        ([6.4, 7.25], OK),
    ],
)
def test_level_ends_only_above_where_it_began(readings_v, level):
    assert after(*readings_v).level(0) is level


@pytest.mark.parametrize(("low_v", "empty_v", "margin_v"), [(12.0, 11.0, 0.5), (3.5, 3.25, 0.0), (26.0, 24.0, 1.0)])
def test_level_follows_the_configuration(low_v, empty_v, margin_v):
    config = BatteryLimits(low_battery_v=low_v, empty_battery_v=empty_v, battery_hysteresis_v=margin_v)
    assert after(low_v, config=config).level(0) is OK
    assert after(low_v - JUST_V, config=config).level(0) is LOW
    assert after(empty_v - JUST_V, config=config).level(0) is EMPTY
    assert after(empty_v - JUST_V, empty_v + margin_v, config=config).level(0) is LOW
    assert after(low_v - JUST_V, low_v + margin_v, config=config).level(0) is OK


def test_voltage_that_recovers_without_load_does_not_toggle():
    monitor, levels = BatteryMonitor(CONFIG), []
    for count in range(50):
        monitor.see(6.4 if count % 2 == 0 else 6.7, count)
        levels.append(monitor.level(count))
    assert set(levels) == {EMPTY}


@pytest.mark.parametrize("t_us", [0, 3, 10_000_000])
def test_battery_is_silent_five_seconds_after_its_newest_reading(t_us):
    monitor = after(8.0, t_us=t_us)
    assert (monitor.level(t_us + 5_000_000), monitor.volts(t_us + 5_000_000)) == (OK, 8.0)
    assert (monitor.level(t_us + 5_000_001), monitor.volts(t_us + 5_000_001)) == (SILENT, None)


def test_battery_without_any_reading_is_silent():
    assert (after().level(0), after().volts(0)) == (SILENT, None)


@pytest.mark.parametrize("volts", [math.nan, math.inf, -math.inf])
def test_reading_that_is_not_finite_is_ignored(volts):
    assert after(volts).level(0) is SILENT
    monitor = after(8.0)
    monitor.see(volts, 5_000_001)
    assert monitor.level(5_000_001) is SILENT


def test_silence_leaves_an_empty_battery_empty_and_a_low_one_slow():
    assert after(6.0).level(6_000_000) is EMPTY
    assert after(6.9).level(6_000_000) is SILENT
    monitor = after(6.9)
    monitor.see(7.2, 6_000_000)
    assert monitor.level(6_000_000) is LOW, "the level before the silence counts"


@pytest.mark.parametrize(
    ("volts", "now_us", "causes"),
    [
        (8.0, 0, []),
        (6.9, 0, [(0.5, "the battery is low; half speed")]),
        (8.0, 6_000_000, [(0.5, "the battery is silent; half speed")]),
        (6.0, 0, [(0.0, "the battery is empty")]),
    ],
)
def test_each_level_has_its_cause(volts, now_us, causes):
    assert [(cause.factor, cause.reason) for cause in after(volts).causes(now_us)] == causes


@pytest.mark.parametrize(("low_v", "empty_v", "fits"), [(7.0, 6.99, True), (7.0, 7.0, False), (7.0, 7.01, False)])
def test_empty_must_be_below_low(low_v, empty_v, fits):
    if fits:
        BatteryLimits(low_battery_v=low_v, empty_battery_v=empty_v)
        return
    with pytest.raises(ValidationError, match="empty_battery_v must be below low_battery_v"):
        BatteryLimits(low_battery_v=low_v, empty_battery_v=empty_v)


@pytest.mark.parametrize(
    ("changes", "fits"),
    [
        ({"low_battery_v": 100.0}, True),
        ({"low_battery_v": 100.01}, False),
        ({"low_battery_v": 100.0, "empty_battery_v": 99.0}, True),
        ({"low_battery_v": 0.002, "empty_battery_v": 0.001}, True),
        ({"empty_battery_v": 0.0}, False),
        ({"low_battery_v": 0.0}, False),
        ({"empty_battery_v": 100.01}, False),
        ({"battery_hysteresis_v": 0.0}, True),
        ({"battery_hysteresis_v": -0.001}, False),
        ({"battery_hysteresis_v": 10.0}, True),
        ({"battery_hysteresis_v": 10.01}, False),
        ({"low_battery_v": math.nan}, False),
    ],
)
def test_voltages_have_bounds(changes, fits):
    if fits:
        assert BatteryLimits.model_validate(changes).model_dump().items() >= changes.items()
        return
    with pytest.raises(ValidationError):
        BatteryLimits(**changes)


def test_defaults_are_those_of_two_lithium_cells():
    assert BatteryLimits().model_dump() == {
        "low_battery_v": 7.0, "empty_battery_v": 6.4, "battery_hysteresis_v": 0.3,
    }  # fmt: skip
