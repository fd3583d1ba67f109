"""Tests of measured motion: what proves that a robot moves, and the rows of a motor log."""

import pytest

from sightline.conformance.measured import (
    MeasuredMotion,
    WheelRow,
    check_motor_log,
    evidence_in_log,
    evidence_of,
    mean_moving,
    mean_travel,
    read_motor_log,
)
from sightline.protocol.errors import ConfigError

STILL = (0.0, 0.0)
ORIGIN = (0.0, 0.0, 0.0)


def series(*movings, pose=lambda number: ORIGIN):
    readings = [MeasuredMotion(number * 50_000, moving, pose(number)) for number, moving in enumerate(movings)]
    return {"odometry": readings}


def times(readings):
    return [one.t_us for one in evidence_of(readings)]


def test_two_readings_in_a_row_prove_motion_and_one_is_noise():
    assert times(series(STILL, (0.2, 0.0), STILL, STILL)) == []
    assert times(series(STILL, (0.2, 0.0), (0.0, 0.4), STILL)) == [50_000]
    assert times(series((0.02, 0.1), (0.02, 0.1), (0.02, 0.1))) == []


def test_pose_that_changes_proves_motion_though_moving_is_zero():
    driven = series(*[STILL] * 8, pose=lambda number: (0.005 * number, 0.0, 0.0))
    assert times(driven) == [0, 50_000, 100_000, 150_000]
    turned = series(*[STILL] * 8, pose=lambda number: (0.0, 0.0, 3.1 + 0.02 * number))
    assert times(turned) == [0, 50_000, 100_000, 150_000]
    assert times(series(*[STILL] * 8, pose=lambda number: (0.001 * number, 0.0, 0.0))) == []


def test_means_are_along_the_heading_and_none_without_motion():
    backwards = series(*[(-0.1, 0.0)] * 9, pose=lambda number: (0.005 * number, 0.0, 3.14159265))
    assert mean_moving(backwards) == pytest.approx((-0.1, 0.0))
    assert mean_travel(backwards) == pytest.approx((-0.1, 0.0), abs=1e-6)
    assert mean_moving(series(*[STILL] * 9)) is None
    assert mean_travel(series(*[STILL] * 9)) is None


def test_motor_log_has_rows_with_or_without_names_and_ignores_an_unfinished_line():
    assert read_motor_log("1,0.5,-0.5\n2,0,0\n3,0", "m.csv") == [WheelRow(1, 0.5, -0.5), WheelRow(2, 0.0, 0.0)]
    named = "t_us,left_rad_s,right_rad_s,left_rad,right_rad\n1,0.5,-0.5,0,0\n"
    assert read_motor_log(named, "m.csv") == [WheelRow(1, 0.5, -0.5)]
    with pytest.raises(ConfigError, match=r"invalid --motor-log m.csv, line 2: expected t_us,left_rad_s,right_rad_s"):
        read_motor_log("1,0,0\nnonsense\n", "m.csv")


def test_motor_log_of_another_run_is_an_error():
    rows = [WheelRow(5_000_000, 0.0, 0.0)]
    check_motor_log(rows, 6_000_000, "r1", "m.csv")
    with pytest.raises(ConfigError, match=r"last row is of 5.0 s on the robot's clock, robot r1 is at 60.0 s"):
        check_motor_log(rows, 60_000_000, "r1", "m.csv")
    with pytest.raises(ConfigError, match="no rows; start robot r1"):
        check_motor_log([], 60_000_000, "r1", "m.csv")


def test_newest_row_of_a_motor_log_holds_until_now():
    rows = [WheelRow(1_000, 3.0, 3.0), WheelRow(2_000, 0.0, 0.0)]
    assert [one.t_us for one in evidence_in_log(rows, 9_000)] == [1_999]
    assert [one.t_us for one in evidence_in_log([*rows, WheelRow(3_000, 0.0, 1.0)], 9_000)] == [1_999, 8_999]
