"""Every number of the range guard: just inside, at it, just outside, for an outline in binary fractions."""

import array
import math
import random

import pytest
from pydantic import ValidationError

from sightline.evaluation.scenario_config import robot_config
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import STILL, Twist
from sightline.robot_side.ports import Ranges
from sightline.robot_side.safety.guard import BlindZoneError, GuardConfig, RangeGuard, check_blind_zone
from sightline.sim.robot import load_robot

DEFAULTS = {
    "front_m": 0.07,
    "rear_m": 0.10,
    "half_width_m": 0.09,
    "sensor_x_m": 0.055,
    "stop_m": 0.08,
    "brake_mps2": 0.5,
    "max_scan_age_ms": 400,
}
# With brake 0.5 the limit is sqrt(clearance - stop): clearance 0.5 leaves sqrt(0.25) = 0.5 m/s.
BOX = {"front_m": 0.5, "rear_m": 1.0, "half_width_m": 0.25, "sensor_x_m": 0.0, "stop_m": 0.25, "brake_mps2": 0.5}


def twist(linear_mps, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def seeing(*points, t_us=0, **changes):
    """A guard that sees one or two points (x_m, y_m) from the axle's midpoint, in this order."""
    guard = RangeGuard(GuardConfig(**{**BOX, **changes}))
    bearings_rad = [math.atan2(y_m, x_m) for x_m, y_m in points]
    ranges_m = array.array("d", [math.hypot(*point) for point in points])
    guard.see(Ranges(t_us, bearings_rad[0], bearings_rad[-1] - bearings_rad[0], 0.0, 100.0, ranges_m))
    return guard


def cut(guard, linear_mps, angular_rad_s=0.0):
    got = guard.limit(twist(linear_mps, angular_rad_s), 0)
    return got.linear_mps, got.angular_rad_s


def near(*values):
    return pytest.approx(values, rel=1e-6, abs=1e-9)


# --- configuration -----------------------------------------------------------------------------------------------


def test_the_defaults_are_as_documented():
    assert GuardConfig().model_dump() == DEFAULTS


@pytest.mark.parametrize(
    ("field", "lower_allowed", "lower", "upper"),
    [
        ("front_m", True, 0.0, 2.0),
        ("rear_m", True, 0.0, 2.0),
        ("half_width_m", False, 0.01, 2.0),
        ("sensor_x_m", True, -2.0, 2.0),
        ("stop_m", True, 0.02, 5.0),
        ("brake_mps2", False, 0.0, 20.0),
        ("max_scan_age_ms", True, 50, 5_000),
    ],
)
def test_each_field_is_bounded(field, lower_allowed, lower, upper):
    step = 1 if field == "max_scan_age_ms" else 1e-6
    allowed = [lower + step, upper - step, upper, *([lower] if lower_allowed else [])]
    for value in allowed:
        assert getattr(GuardConfig(**{field: value}), field) == value
    for value in [lower - step, upper + step, *([] if lower_allowed else [lower])]:
        with pytest.raises(ValidationError):
            GuardConfig(**{field: value})


# --- towards a point ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("clearance_m", "limit_mps"),
    [(0.0001, 0.0), (0.2499, 0.0), (0.25, 0.0), (0.26, 0.1), (0.5, 0.5), (1.25, 1.0), (4.25, 2.0)],
)
def test_speed_toward_a_point_permits_braking(clearance_m, limit_mps):
    ahead, behind = seeing((0.5 + clearance_m, 0.0)), seeing((-1.0 - clearance_m, 0.0))
    assert cut(ahead, 3.0) == near(limit_mps, 0.0)
    assert cut(behind, -3.0) == near(-limit_mps, 0.0)
    assert cut(ahead, -3.0) == (-3.0, 0.0), "away is free"
    assert cut(behind, 3.0) == (3.0, 0.0)
    assert cut(ahead, 0.9 * limit_mps) == (0.9 * limit_mps, 0.0), "slower than that is left alone"


def test_the_braking_sets_the_limit():
    assert cut(seeing((1.25, 0.0), brake_mps2=2.0), 3.0) == near(math.sqrt(2 * 2.0 * 0.5), 0.0)


def test_unlimited_twist_is_returned_unchanged():
    guard, slow, fast = seeing((1.0, 0.0)), twist(0.49), twist(0.51)
    assert guard.limit(slow, 0) is slow
    assert guard.limit(fast, 0) is not fast
    turning = seeing((0.25, 0.5))
    assert turning.limit(spin := twist(0.0, -3.0), 0) is spin


@pytest.mark.parametrize("side", [1, -1])
def test_along_a_wall_is_free_and_turning_into_it_is_not(side):
    # Beside the outline at x = 0.25, 0.25 + 0.01 m off: closing speed is angular x 0.25, at most sqrt(0.01) = 0.1.
    guard = seeing((0.25, side * 0.51))
    assert cut(guard, 3.0) == (3.0, 0.0) and cut(guard, -3.0) == (-3.0, 0.0)
    assert cut(guard, 0.0, side * 3.0) == near(0.0, side * 0.4)
    assert cut(guard, 2.0, side * 3.0) == near(0.0, side * 0.4), "the speed gives way before the turn"
    assert cut(guard, 2.0, side * -3.0) == (2.0, side * -3.0)
    assert cut(guard, 2.0, side * 0.39) == (2.0, side * 0.39)


@pytest.mark.parametrize("side", [1, -1])
def test_behind_the_axle_a_turn_swings_the_other_way(side):
    guard = seeing((-0.5, side * 0.51))
    assert cut(guard, 0.0, side * -3.0) == near(0.0, side * -0.2)
    assert cut(guard, 0.0, side * 3.0) == (0.0, side * 3.0)


@pytest.mark.parametrize("side", [1, -1])
def test_a_corner_closes_in_by_both(side):
    # From the corner (0.5, 0.25) the point lies 0.3 forward, 0.4 sideways: clearance 0.5, limit 0.5, n = (0.6, 0.8).
    guard = seeing((0.8, side * 0.65))
    turning = 0.8 * 0.5 - 0.6 * 0.25
    assert cut(guard, 3.0) == near(0.5 / 0.6, 0.0)
    assert cut(guard, 3.0, side * 1.0) == near((0.5 - turning) / 0.6, side * 1.0)
    assert cut(guard, 3.0, side * -1.0) == near((0.5 + turning) / 0.6, side * -1.0)
    assert cut(guard, 3.0, side * 5.0) == near(0.0, side * 0.5 / turning)
    assert cut(guard, 0.0, side * 3.0) == near(0.0, side * 0.5 / turning)
    rear = seeing((-1.3, side * 0.65))
    # n = (-0.6, 0.8) at (-1, 0.25): turning = -0.8 + 0.15.
    assert cut(rear, -3.0, side * -0.5) == near(-(0.5 - 0.5 * 0.65) / 0.6, side * -0.5)


def test_a_turn_that_uses_the_whole_limit_leaves_no_speed():
    guard = seeing((1.0, 0.0), (0.8, 0.65))
    turning = 0.8 * 0.5 - 0.6 * 0.25
    linear, angular = cut(guard, 3.0, 0.5 / turning)
    assert linear == pytest.approx(0.0, abs=1e-9) and angular == pytest.approx(0.5 / turning)


def test_exactly_the_limit_is_left_alone():
    guard = seeing((1.0, 0.0))
    assert cut(guard, 0.5) == (0.5, 0.0)
    exact = twist(0.5)
    assert guard.limit(exact, 0) is exact


def test_cutting_for_one_point_is_looked_at_again_for_those_before_it():
    # Driving on takes the tail out of the turn's way; once a wall ahead cuts the speed the turn must give way too.
    tail, wall = (-1.3, -0.65), (0.76, 0.0)
    # tail: n = (-0.6, -0.8) at (-1, -0.25), turning = 0.8 - 0.15 = 0.65, limit 0.5; wall: limit 0.1.
    assert cut(seeing(tail), 2.0, 2.0) == (2.0, 2.0)
    assert cut(seeing(tail, wall), 2.0, 2.0) == near(0.0, 0.5 / 0.65)
    assert cut(seeing(wall, tail), 2.0, 2.0) == near(0.0, 0.5 / 0.65)


def test_late_limit_of_a_turn_applies_to_earlier_points():
    guard = seeing((50.0, 0.0))
    # Two behind the tail that only the speed keeps away, the nearer one first; then a wall that cuts the speed to 0.45.
    guard._near = [(-1.0, 0.5, 0.06), (-1.0, 0.6, 0.1), (1.0, 0.0, 0.45)]
    assert cut(guard, 1.0, 1.0) == near(0.0, 0.12)
    assert cut(guard, 0.5, 0.5) == near(0.45, 0.5)


def limited_in_full(points, config, linear, angular):
    """The definition, point by point and pass by pass, without any shortcut."""
    for _ in range(3):
        for x_m, y_m in points:
            spot_x_m = min(max(x_m, -config.rear_m), config.front_m)
            spot_y_m = min(max(y_m, -config.half_width_m), config.half_width_m)
            clearance_m = math.hypot(x_m - spot_x_m, y_m - spot_y_m)
            forward, sideways = (x_m - spot_x_m) / clearance_m, (y_m - spot_y_m) / clearance_m
            turning = sideways * spot_x_m - forward * spot_y_m
            limit_mps = math.sqrt(2 * config.brake_mps2 * max(0.0, clearance_m - config.stop_m))
            if linear * forward + angular * turning > limit_mps:
                free_mps = limit_mps - angular * turning
                linear, angular = (free_mps / forward, angular) if free_mps >= 0 else (0.0, limit_mps / turning)
    return linear, angular


@pytest.mark.parametrize("seed", range(20))
def test_every_point_of_a_scan_limits_the_twist_in_each_pass(seed):
    draw, config = random.Random(seed), GuardConfig(**BOX)
    nearest_m = draw.choice([1.15, 1.3, 1.6])  # the corners of the outline are 1.04 m away
    ranges_m = array.array("d", [draw.uniform(nearest_m, 3.0) for _ in range(100)])
    guard = RangeGuard(config)
    guard.see(Ranges(0, -math.pi, math.tau / 100, 0.0, 100.0, ranges_m))
    bearings_rad = [-math.pi + index * (math.tau / 100) for index in range(100)]
    pairs = zip(ranges_m, bearings_rad, strict=True)
    points = [(range_m * math.cos(bearing_rad), range_m * math.sin(bearing_rad)) for range_m, bearing_rad in pairs]
    for _ in range(30):
        wanted = draw.uniform(-2, 2), draw.uniform(-4, 4)
        assert cut(guard, *wanted) == near(*limited_in_full(points, config, *wanted))


# --- inside the outline ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("y_m", [0.0, 0.2, -0.2, 0.25, -0.25])
@pytest.mark.parametrize("x_m", [0.5, 0.01, 0.4999, 0.5 + 5e-7])
def test_a_point_inside_the_outline_is_straight_ahead_or_behind(x_m, y_m):
    ahead = seeing((x_m, y_m))
    assert cut(ahead, 3.0) == near(0.0, 0.0) and cut(ahead, -3.0) == (-3.0, 0.0)
    behind = seeing((-x_m, y_m))
    assert cut(behind, -3.0) == near(0.0, 0.0) and cut(behind, 3.0) == (3.0, 0.0)


@pytest.mark.parametrize("side", [1, -1])
def test_a_point_inside_forbids_the_turn_that_moves_its_spot_forward(side):
    guard = seeing((0.25, side * 0.2))
    assert cut(guard, 0.0, side * 3.0) == (0.0, side * 3.0)
    assert cut(guard, 0.0, side * -3.0) == near(0.0, 0.0)
    assert cut(guard, 3.0, side * 1.0) == near(0.2, side * 1.0), "its spot moves at 3 - 0.2 x 1"


@pytest.mark.parametrize(("clearance_m", "inside"), [(0.995e-6, True), (1.005e-6, False)])
def test_inside_ends_a_micrometer_off_the_outline(clearance_m, inside):
    guard = seeing((0.25, 0.25 + clearance_m))
    assert (cut(guard, 3.0)[0] < 1e-3) == inside, "beside the outline driving on is free"


# --- scans -------------------------------------------------------------------------------------------------------


def scan(ranges_m, *, first_rad=0.0, each_rad=0.0, t_us=0, least_m=0.0, most_m=100.0):
    return Ranges(t_us, first_rad, each_rad, least_m, most_m, array.array("d", ranges_m))


def box(**changes):
    return RangeGuard(GuardConfig(**{**BOX, **changes}))


@pytest.mark.parametrize(
    ("range_m", "counts"),
    [
        (-math.inf, True), (1e-9, True), (0.59, True), (0.6, True), (0.61, True), (0.7, True), (0.71, False),
        (math.inf, False), (0.0, False), (-0.0, False),
    ],
)  # fmt: skip
def test_echo_below_the_minimum_range_counts(range_m, counts):
    guard = box()
    guard.see(scan([math.inf, range_m], least_m=0.6, most_m=0.7))
    assert (cut(guard, 3.0) != (3.0, 0.0)) == counts


@pytest.mark.parametrize("range_m", [1e-9, 0.3, 0.9999, 1.0])
def test_object_too_close_to_measure_is_at_the_minimum_range(range_m):
    guard = box()
    guard.see(scan([range_m], least_m=1.0))
    assert cut(guard, 3.0) == near(0.5, 0.0) and cut(guard, -3.0) == (-3.0, 0.0)


@pytest.mark.parametrize("ranges_m", [[], [0.0], [0.0, -0.0, 0.0], [0.71], [0.0, 0.71]])
def test_scan_without_any_echo_is_ignored(ranges_m):
    guard = box(max_scan_age_ms=50)
    guard.see(scan([0.65], least_m=0.6, most_m=0.7))
    guard.see(scan(ranges_m, t_us=10_000, least_m=0.6, most_m=0.7))
    assert guard.is_fresh(50_000) and not guard.is_fresh(50_001)
    assert cut(guard, 3.0) != (3.0, 0.0), "what the last one forbids holds"


@pytest.mark.parametrize("range_m", [0.3, 0.6, 0.7, math.inf])
def test_scan_with_one_echo_is_accepted(range_m):
    guard = box(max_scan_age_ms=50)
    guard.see(scan([0.0, range_m, 0.71], least_m=0.6, most_m=0.7))
    assert guard.is_fresh(50_000)


@pytest.mark.parametrize("most_m", [math.inf, math.nan])
def test_a_sensor_without_a_greatest_range_sees_nothing_at_inf(most_m):
    guard = box()
    guard.see(scan([math.inf, math.inf], each_rad=1.0, most_m=most_m))
    assert cut(guard, 3.0, 1.0) == (3.0, 1.0)
    guard.see(scan([1.0, math.inf], each_rad=1.0, most_m=most_m))
    assert cut(guard, 3.0) == near(0.5, 0.0)
    guard.see(scan([1e308, 1e308], each_rad=1.0, most_m=most_m))
    assert cut(guard, 3.0, 1.0) == (3.0, 1.0)


@pytest.mark.parametrize("at", [0, 1])
def test_a_scan_with_a_nan_is_not_taken(at):
    guard, ranges_m = box(max_scan_age_ms=50), [math.inf, math.inf]
    guard.see(scan(ranges_m))
    ranges_m[at] = math.nan
    guard.see(scan(ranges_m, t_us=10_000))
    assert guard.is_fresh(50_000) and not guard.is_fresh(50_001)


@pytest.mark.parametrize(
    ("ranges_m", "quarter"),
    [([1.0, math.inf, math.inf], 0), ([math.inf, 1.0, math.inf], 1), ([math.inf, math.inf, 1.25], 2)],
)
def test_each_range_lies_at_its_own_angle(ranges_m, quarter):
    guard = box()
    guard.see(scan(ranges_m, each_rad=math.pi / 2))
    expected = [near(0.5, 0.0), (3.0, 0.0), (3.0, 0.0)][quarter]
    assert cut(guard, 3.0) == expected
    expected_back = [(-3.0, 0.0), (-3.0, 0.0), near(0.0, 0.0)][quarter]
    assert cut(guard, -3.0) == expected_back
    guard.see(scan([1.0], first_rad=math.pi, each_rad=1.0))
    assert cut(guard, 3.0) == (3.0, 0.0) and cut(guard, -3.0) == near(0.0, 0.0)


def test_angles_are_counter_clockwise():
    guard = box()
    guard.see(scan([math.hypot(0.25, 0.51)], first_rad=math.atan2(0.51, 0.25)))
    assert cut(guard, 0.0, 3.0) == near(0.0, 0.4)
    assert cut(guard, 0.0, -3.0) == (0.0, -3.0)


@pytest.mark.parametrize("sensor_x_m", [-0.25, 0.0, 0.25])
def test_the_sensor_sits_forward_of_the_axle(sensor_x_m):
    guard = box(sensor_x_m=sensor_x_m)
    guard.see(scan([1.0 - sensor_x_m]))
    assert cut(guard, 3.0) == near(0.5, 0.0)


def test_a_new_scan_replaces_the_last():
    guard = box()
    guard.see(scan([0.6]))
    guard.see(scan([50.0]))
    assert cut(guard, 3.0) == (3.0, 0.0)
    guard.see(scan([0.6]))
    guard.see(scan([math.inf]))
    assert cut(guard, 3.0) == (3.0, 0.0)


@pytest.mark.parametrize(
    ("age_us", "fresh"), [(-1, False), (0, True), (1, True), (399_999, True), (400_000, True), (400_001, False)]
)
def test_a_scan_is_believed_for_its_age(age_us, fresh):
    guard = seeing((50.0, 0.0), t_us=1_000)
    asked = twist(0.5, -1.0)
    assert guard.is_fresh(1_000 + age_us) == fresh
    assert guard.limit(asked, 1_000 + age_us) == (asked if fresh else STILL)


def test_without_any_scan_nothing_moves():
    guard = RangeGuard(GuardConfig())
    assert not guard.is_fresh(0)
    assert guard.limit(twist(0.5), 0) == guard.limit(twist(0.0, 0.5), 0) == STILL
    assert guard.limit(STILL, 0) is STILL


# A range sensor that is blind beyond the guard's stop zone is rejected with a readable error, and nothing moves.


# Binary fractions: front 0.5, rear 1, half as wide 0.25, so that "just" is just.
BLIND_BOX = {"front_m": 0.5, "rear_m": 1.0, "half_width_m": 0.25, "sensor_x_m": 0.0, "stop_m": 0.25}


def blind_scan(least_m, first_rad=0.0, each_rad=0.0, rays=1):
    return Ranges(0, first_rad, each_rad, least_m, 8.0, array.array("f", [math.inf] * rays))


def is_refused(sees, **guard):
    try:
        check_blind_zone(GuardConfig(**{**BLIND_BOX, **guard}), sees)
    except BlindZoneError:
        return True
    return False


@pytest.mark.parametrize(("looks_rad", "edge_m"), [
    (0.0, 0.5 + 0.25), (math.pi, 1.0 + 0.25), (math.pi / 2, 0.25 + 0.25), (-math.pi / 2, 0.25 + 0.25),
])  # fmt: skip
def test_blind_zone_ends_within_the_stop_zone_in_each_direction(looks_rad, edge_m):
    assert not is_refused(blind_scan(edge_m - 1e-6, looks_rad))
    assert is_refused(blind_scan(edge_m + 1e-6, looks_rad))


def test_as_far_as_the_stop_zone_is_too_far():
    assert is_refused(blind_scan(0.75)) and not is_refused(blind_scan(0.75), stop_m=0.25001)


@pytest.mark.parametrize(("sensor_x_m", "refused"), [(-0.2, False), (0.2, True)])
def test_where_the_sensor_sits_counts(sensor_x_m, refused):
    assert is_refused(blind_scan(0.6), sensor_x_m=sensor_x_m) == refused


def test_space_between_robot_and_sensor_counts_as_blind():
    assert is_refused(blind_scan(0.0), sensor_x_m=0.76) and not is_refused(blind_scan(0.0), sensor_x_m=0.74)


@pytest.mark.parametrize(("sensor_x_m", "rejected"), [(0.755, True), (0.745, False)])
def test_a_sensor_ahead_that_looks_back_counts_from_where_it_sits(sensor_x_m, rejected):
    assert is_refused(blind_scan(0.0, math.pi), sensor_x_m=sensor_x_m) == rejected


def test_a_scan_without_rays_has_no_blind_zone():
    assert not is_refused(blind_scan(8.0, rays=0), stop_m=0.02)


@pytest.mark.parametrize("rays", [1, 2, 360])
def test_each_ray_is_computed_once(rays, monkeypatch):
    """A scan may have 16,384 rays, and the wheels wait for the check."""
    angles_rad, cos = [], math.cos
    monkeypatch.setattr("sightline.robot_side.safety.guard.math.cos", lambda at: angles_rad.append(at) or cos(at))
    assert not is_refused(blind_scan(0.1, 0.0, 0.01, rays))
    assert len(angles_rad) == rays + 1, "and the sensor itself"


@pytest.mark.parametrize(("first_rad", "each_rad", "refused"), [
    (-math.pi, math.pi / 2, True), (-math.pi, math.pi, False), (math.pi / 4, math.pi / 4, True),
])  # fmt: skip
def test_blind_zone_is_checked_only_in_sensor_directions(first_rad, each_rad, refused):
    """0.6 is too much to the sides, not ahead and behind."""
    assert is_refused(blind_scan(0.6, first_rad, each_rad, rays=2), stop_m=0.3) == refused


@pytest.mark.parametrize("least_m", [math.nan, math.inf])
def test_a_minimum_that_is_not_a_number_is_a_bad_reading(least_m):
    with pytest.raises(ValueError, match="not finite") as caught:
        check_blind_zone(GuardConfig(**BLIND_BOX), blind_scan(least_m))
    assert not isinstance(caught.value, BlindZoneError)


def test_error_names_the_setting():
    with pytest.raises(BlindZoneError, match=r"guard.stop_m = 0.25: .* below 1 m, .* 0.500 m beyond .* outline"):
        check_blind_zone(GuardConfig(**BLIND_BOX), blind_scan(1.0))


def test_a_simulated_robot_is_rejected_with_its_name():
    model = load_robot("gazebo-raspi").model_copy(update={"settings": {"guard": {"stop_m": 0.08}}})
    with pytest.raises(ConfigError, match=r"^robot gazebo-raspi: \[settings\] guard.stop_m = 0.08: .* below 0.1 m.*$"):
        robot_config(model)
