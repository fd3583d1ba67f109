"""Draw the start of the robot and of all variable objects from the seed. Pure (NumPy's seeded generators)."""

import math

import numpy as np

from sightline.sim.scenario import Light, OnPath, Place, Scenario, Start, Static

# Each draw has its own random stream, so that another thing in a scenario changes nothing else.
_PATH, _START, _THING_PATH, _JITTER, _LIGHT = 1, 2, 7, 8, 9


def target_phase(target: OnPath, seed: int) -> float:
    """Return the start of the target on its path, as a fraction."""
    return float(np.random.default_rng([seed, _PATH]).uniform(*target.phase))


def thing_phase(thing: OnPath, number: int, seed: int) -> float:
    """Return the same for the thing with this number."""
    return float(np.random.default_rng([seed, _THING_PATH, number]).uniform(*thing.phase))


def thing_place(thing: Static, number: int, seed: int) -> Place:
    """Return the place of a static thing."""
    x_m, y_m = thing.at_m
    if thing.jitter_m:
        moved = np.random.default_rng([seed, _JITTER, number]).uniform(-thing.jitter_m, thing.jitter_m, 2)
        x_m, y_m = x_m + float(moved[0]), y_m + float(moved[1])
    return Place(x_m, y_m, math.radians(thing.heading_deg))


def light_begin(light: Light, seed: int) -> float:
    """Return the start of the light in its cycle, as a fraction."""
    return float(np.random.default_rng([seed, _LIGHT]).uniform(*light.begin))


def robot_start(start: Start, target: Place, lens_x_m: float, seed: int) -> Place:
    """Return the start of the axle's midpoint: on the map, or relative to the target as in `start`."""
    draw = np.random.default_rng([seed, _START])
    if start.at_m is not None:
        moved = draw.uniform(-start.jitter_m, start.jitter_m, 2)
        heading_rad = math.radians(draw.uniform(*start.heading_deg))
        return Place(start.at_m[0] + float(moved[0]), start.at_m[1] + float(moved[1]), heading_rad)
    distance_m = _outside(float(draw.uniform(*start.distance_m)), start.except_m)
    bearing_rad = math.radians(draw.uniform(*start.bearing_deg))
    from_ball_rad = target.heading_rad + math.radians(draw.uniform(*start.approach_deg))
    yaw_rad = math.remainder(from_ball_rad + math.pi - bearing_rad, math.tau)
    return Place(
        target.x_m + distance_m * math.cos(from_ball_rad) - lens_x_m * math.cos(yaw_rad),
        target.y_m + distance_m * math.sin(from_ball_rad) - lens_x_m * math.sin(yaw_rad),
        yaw_rad,
    )


def _outside(distance_m: float, span_m: tuple[float, float] | None) -> float:
    """Return the distance, moved to the nearer end of the span at which no run starts."""
    if span_m is None or not span_m[0] < distance_m < span_m[1]:
        return distance_m
    return min(span_m, key=lambda end_m: abs(end_m - distance_m))


def goals_seen(scenario: Scenario, seed: int) -> list[tuple[float, float]]:
    """Return the scenario's waypoints in the robot's odometry frame, from its start: x ahead, y left."""
    at = robot_start(scenario.start, Place(0.0, 0.0, 0.0), 0.0, seed)
    cos, sin = math.cos(at.heading_rad), math.sin(at.heading_rad)
    aways = [(x_m - at.x_m, y_m - at.y_m) for x_m, y_m in scenario.goals_m]
    return [(x_m * cos + y_m * sin, y_m * cos - x_m * sin) for x_m, y_m in aways]
