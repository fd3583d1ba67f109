"""The drive on a Raspberry Pi's pins: duty by table, pins by gpiozero's own mock, every failure low."""

import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.fixtures import demanded

demanded.module("gpiozero", "robot-pi")
from gpiozero import Device
from gpiozero.pins.mock import MockFactory

from sightline.operator_side.config.loading import load_service
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import Twist
from sightline.robot_side.hardware.gpio import DutyTable, GpioDrive, table_of, table_text
from sightline.robot_side.kinematics import DiffDriveConfig, wheel_speeds
from sightline.robot_side.plugins import DRIVES
from tests.contracts.drives import check_drive
from tests.fixtures.gpio import LEFT, RIGHT, FakeLgpio, NotingPin, both_ways, config

ROOT = Path(__file__).parent.parent.parent.parent
ROWS = ((0.4, 0.08), (0.6, 0.12), (1.0, 0.19))


def duties(board):
    """The duty of every used pin that is not low."""
    return {number: value for number, value in dict(board.events).items() if value}


# --- the table -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed_mps", "duty"), [
    (0.0, 0.0), (-0.0, 0.0), (0.039, 0.0), (0.041, 0.4), (0.08, 0.4), (0.10, 0.5), (0.12, 0.6), (0.155, 0.8),
    (0.19, 1.0), (5.0, 1.0), (-0.10, -0.5), (-9.0, -1.0), (-0.039, 0.0),
])  # fmt: skip
def test_a_speed_is_the_duty_of_the_table(speed_mps, duty):
    assert DutyTable(ROWS).duty(speed_mps) == pytest.approx(duty, abs=1e-12)


@example([(0.4375, 0.5), (0.03125, 0.25)], 0.5)
@given(st.lists(st.tuples(st.floats(0.01, 1), st.floats(0.001, 3)), min_size=1, max_size=8), st.floats(-4, 4))
def test_any_table_keeps_direction_stays_in_range_and_is_its_own_inverse(rows, speed_mps):
    pairs = zip(sorted({round(d, 2) for d, _ in rows}), sorted({round(v, 3) for _, v in rows}), strict=False)
    rising = [pair for pair in pairs if pair[0] > 0 and pair[1] > 0]
    table = DutyTable(rising)
    duty = table.duty(speed_mps)
    assert duty == 0 or rising[0][0] <= abs(duty) <= rising[-1][0]
    assert duty * speed_mps >= 0
    if rising[0][1] <= abs(speed_mps) <= rising[-1][1]:
        assert table.speed(duty) == pytest.approx(speed_mps, rel=1e-6)


def test_a_written_table_reads_back():
    assert table_of(table_text(ROWS, "measured"), "x.toml") == ROWS


@pytest.mark.parametrize(("text", "says"), [
    ("table = [", "invalid TOML"), ("table = [[0.4, 0.1], [0.4, 0.2]]", "both must rise"),
    ("table = [[0.4, 0.2], [0.6, 0.1]]", "both must rise"), ("table = [[1.4, 0.2]]", "less than or equal to 1"),
    ("table = [[0.4, nan]]", "finite"), ("tabel = [[0.4, 0.1]]", "tabel"), ("table = []", "at least 1"),
    ("", "key 'table' is missing; rows are"),
    ("table = [[0.4]]", "table.0"), ("table = [[0.0, 0.1]]", "greater than 0"),
    (f"table = {'9' * 5000}", "invalid TOML"), (f"table = {'[' * 5000}", "invalid TOML"),
])  # fmt: skip
def test_a_broken_table_is_one_line_with_its_file(text, says):
    with pytest.raises(ConfigError) as error:
        table_of(text, "my.toml")
    assert str(error.value).startswith("my.toml: ") and says in str(error.value) and "\n" not in str(error.value)


def test_table_file_replaces_the_table_and_a_missing_file_is_reported(board, tmp_path):
    path = tmp_path / "drive.toml"
    path.write_text("\N{BYTE ORDER MARK}table = [[0.5, 0.2]]")
    drive = GpioDrive(config(table_file=path))
    drive.set(0.2 / 0.0325, 0.0)
    assert duties(board) == {10: 0.5}
    drive.close()
    with pytest.raises(ConfigError, match="sightline calibrate drive"):
        GpioDrive(config(table_file=tmp_path / "absent.toml"))


# --- the configuration -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("options", "says"), [
    ({"left_forward_pin": 9}, "pin 9 is named twice"), ({"enable_pins": (7,)}, "pin 7 is named twice"),
    ({"pulse_pin": 7}, "pin 7 is named twice"),
    ({"right_forward_pin": 28}, "less than or equal to 27"), ({"right_forward_pin": 1}, "greater than or equal to 2"),
    ({"pwm_hz": 20}, "400"), ({"trim": 0.5}, "0.3"), ({"table_file": "x", "table": [[0.5, 0.2]]}, "keep one"),
    ({"left_forwad_pin": 10}, "left_forwad_pin"), ({"odometry": "encoders"}, "'table' or 'none'"),
])  # fmt: skip
def test_wrong_pins_and_options_are_rejected(options, says):
    with pytest.raises(ValidationError) as error:
        config(**options)
    assert says in str(error.value)


def test_the_radius_comes_from_the_robots_own_wheels():
    robot = load_service("robot", environ={}, sets=["drive.kind=gpio", "wheels.wheel_radius_m=0.05"]).config
    assert robot.motors.options == {"wheel_radius_m": 0.05}


def test_example_of_the_car_is_valid_and_has_the_legacy_speeds(board):
    """60 % straight ahead and 40 % turning on the spot, at the limits of the file."""
    robot = load_service("robot", file=str(ROOT / "examples/raspberry-car.toml"), environ={}).config
    plugin, options = DRIVES.load(robot.motors)
    assert options.pins == (10, 9, 8, 7) and options.pwm_hz == 2000
    drive, limits = plugin(options), robot.safety
    straight = Twist(linear_mps=limits.max_linear_mps, angular_rad_s=0.0)
    drive.set(*wheel_speeds(robot.wheels, straight))
    assert duties(board) == {17: 1, 10: pytest.approx(0.6, abs=0.01), 8: pytest.approx(0.6, abs=0.01)}
    turning = Twist(linear_mps=0.0, angular_rad_s=limits.max_angular_rad_s)
    drive.set(*wheel_speeds(robot.wheels, turning))
    assert duties(board) == {17: 1, 9: pytest.approx(0.4, abs=0.01), 8: pytest.approx(0.4, abs=0.01)}
    drive.close()


# --- the pins --------------------------------------------------------------------------------------------------------


def test_every_pin_is_pwm_at_its_frequency_and_low_at_first(board, drive):
    for number in (*LEFT, *RIGHT):
        pin = board.pin(f"GPIO{number}")
        assert (pin.function, pin.frequency, pin.state) == ("output", 2000, 0.0)


@pytest.mark.parametrize(("options", "expected"), [
    ({}, {10: 0.5, 7: 0.5}), ({"left_reversed": True}, {9: 0.5, 7: 0.5}), ({"right_reversed": True}, {10: 0.5, 8: 0.5}),
    ({"swapped": True}, {9: 0.5, 8: 0.5}), ({"trim": 0.2}, {10: 0.4, 7: 0.5}), ({"trim": -0.2}, {10: 0.5, 7: 0.4}),
])  # fmt: skip
def test_options_decide_the_direction_of_each_wheel(board, options, expected):
    drive = GpioDrive(config(**options))
    drive.set(0.10 / 0.0325, -0.10 / 0.0325)
    assert duties(board) == pytest.approx(expected)
    drive.close()


speeds = st.one_of(st.floats(-20, 20), st.sampled_from([0.0, -0.0, 1e-12, 1e6, -1e6]))


@settings(max_examples=150)
@given(st.lists(st.tuples(speeds, speeds), max_size=40), st.booleans(), st.booleans())
def test_no_motor_is_driven_in_both_directions(twists, swapped, is_reversed):
    factory = MockFactory(pin_class=NotingPin)
    factory.events = []
    Device.pin_factory, before = factory, Device.pin_factory
    paused = []
    try:
        drive = GpioDrive(config(swapped=swapped, left_reversed=is_reversed), pause=paused.append)
        for linear, angular in twists:
            drive.set(*wheel_speeds(DiffDriveConfig(), Twist(linear_mps=linear, angular_rad_s=angular)))
        drive.close()
    finally:
        Device.pin_factory = before
    assert not both_ways(factory.events)
    assert not any(dict(factory.events).values())
    assert set(paused) <= {2 / 2000}


def test_a_reversal_leaves_both_pins_low_for_two_periods(board):
    during = []
    drive = GpioDrive(config(), pause=lambda seconds: during.append((seconds, duties(board))))
    drive.set(4.0, 4.0)
    assert during == []
    drive.set(-4.0, 4.0)
    assert during == [(0.001, {8: pytest.approx(0.625, abs=0.05)})], "only the wheel that reverses lets go"
    assert set(duties(board)) == {9, 8}
    drive.close()


def test_unchanged_speeds_write_nothing(board, drive):
    drive.set(4.0, 4.0)
    count = len(board.events)
    for _ in range(50):
        drive.set(4.0, 4.0)
    assert len(board.events) == count


@pytest.mark.parametrize("speeds", [(float("nan"), 1.0), (1.0, float("inf"))])
def test_speed_that_is_not_finite_sets_all_pins_low(board, drive, speeds):
    drive.set(4.0, 4.0)
    with pytest.raises(HardwareError, match="not finite"):
        drive.set(*speeds)
    assert duties(board) == {}


@pytest.mark.parametrize("broken", [10, 9, 8, 7])
def test_a_pin_that_fails_brings_all_others_down_and_the_enable_line(board, monkeypatch, broken):
    drive = GpioDrive(config(enable_pins=(17,)))
    drive.set(4.0, -4.0)
    assert dict(board.events)[17] == 1
    pin, fail = board.pin(f"GPIO{broken}"), SimpleNamespace(now=True)

    def failing(value, write=pin._set_state):
        if fail.now:
            raise OSError("bad line")
        write(value)

    monkeypatch.setattr(pin, "_set_state", failing)
    with pytest.raises(HardwareError, match="bad line; the pins are low"):
        drive.set(-4.0, 4.0)
    assert set(duties(board)) <= {broken}
    fail.now = False
    with pytest.raises(HardwareError, match="until the next zero speed"):
        drive.set(-3.0, 3.0)
    assert set(duties(board)) <= {broken}
    drive.set(0.0, 0.0)
    assert duties(board) == {}, "the failed write is repeated now"
    drive.set(4.0, 4.0)
    assert set(duties(board)) == {17, 10, 8}
    drive.close()


def test_the_enable_line_is_high_from_the_first_motion_to_the_end(board):
    drive = GpioDrive(config(enable_pins=(17, 27)))
    drive.set(0.0, 0.0)
    assert duties(board) == {}
    drive.set(4.0, 4.0)
    drive.set(0.0, 0.0)
    assert duties(board) == {17: 1, 27: 1}, "at zero the bridge brakes; cut off it would coast"
    drive.close()
    assert duties(board) == {}


def test_the_pulse_pin_changes_with_each_command_that_the_pins_take(board):
    drive = GpioDrive(config(pulse_pin=17))
    for speed_rad_s in (0.0, 0.0, 4.0, 4.0):
        drive.set(speed_rad_s, 0.0)
    assert [value for number, value in board.events if number == 17] == [1, 0, 1, 0]
    with pytest.raises(HardwareError):
        drive.set(float("nan"), 0.0)
    drive.set(4.0, 0.0)
    drive.close()
    assert [value for number, value in board.events if number == 17] == [1, 0, 1, 0, 1, 0]
    assert board.pin("GPIO17").function == "input"


def test_close_leaves_no_output_pin(board):
    drive = GpioDrive(config())
    drive.set(4.0, 4.0)
    drive.close()
    assert duties(board) == {}
    assert {board.pin(f"GPIO{number}").function for number in (*LEFT, *RIGHT)} == {"input"}
    with pytest.raises(HardwareError, match="closed"):
        drive.set(1.0, 1.0)


def test_pins_are_low_before_their_release():
    calls = []
    pins = SimpleNamespace(
        write=lambda number, duty: calls.append((number, duty)), enable=calls.append, pulse=lambda: None,
        close=lambda: calls.append("close"),
    )  # fmt: skip
    drive = GpioDrive(config(), opening=lambda _config: pins)
    drive.set(4.0, 4.0)
    calls.clear()
    drive.close()
    drive.close()
    assert calls == [False, *((number, 0.0) for number in (*LEFT, *RIGHT)), "close"]


def test_the_expected_wheels_turn_as_the_table_states(drive, monkeypatch):
    clock = SimpleNamespace(us=1_000_000)
    monkeypatch.setattr("sightline.robot_side.hardware.gpio.monotonic_us", lambda: clock.us)
    drive.set(0.0, 0.0)
    start = drive.wheels()
    drive.set(0.05 / 0.0325, -1.0)  # less than the least duty gives: it turns at that
    clock.us += 2_000_000
    now = drive.wheels()
    assert now.left_rad - start.left_rad == pytest.approx(2 * 0.08 / 0.0325)
    assert now.right_rad == start.right_rad, "below half of the least speed nothing turns"
    assert now.t_us == clock.us


def test_without_odometry_there_is_no_reading(board):
    drive = GpioDrive(config(odometry="none"))
    drive.set(4.0, 4.0)
    assert drive.wheels() is None
    drive.close()


def test_gpio_drive_keeps_the_contract(board, monkeypatch):
    monkeypatch.setitem(sys.modules, "lgpio", FakeLgpio())
    zero = partial(GpioDrive.zero, config().model_dump(mode="json"))
    check_drive(lambda: GpioDrive(config()), zero, speed_rad_s=4.0)
