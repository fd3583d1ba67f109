"""Create the configuration of robot and vision service for a simulated scenario. Pure.

All settings are visible: `sightline demo` writes both files to its run folder.
"""

import array
import math
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sightline.protocol.config import first_problem
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.ports import Ranges
from sightline.robot_side.safety.guard import BlindZoneError, check_blind_zone
from sightline.sim.robot import RobotModel, load_robot, outline
from sightline.sim.scenario import Scenario
from sightline.sim.toml_file import laid_over
from sightline.sim.world.start import goals_seen
from sightline.vision_side.config import VisionConfig

Table = dict[str, Any]
Model = TypeVar("Model", bound=BaseModel)

_KEPT_BACK = 0.88  # of a wheel's top speed: the rest lets a motor catch up
_MARGIN_M = 0.01  # around the drawn outline


def robot_of(scenario: Scenario, model: str | None = None) -> RobotModel:
    """Return the robot of `scenario`, or the requested one. Raises ConfigError."""
    return load_robot(model or scenario.robot)


def robot_table(model: RobotModel) -> Table:
    """Return robot.toml of this robot: its wheels, its outline, and the settings of its file."""
    reach = outline(model)
    measured = {
        "wheels": {
            "wheel_radius_m": model.wheels.radius_m, "track_width_m": model.wheels.track_m,
            "max_wheel_rad_s": round(_KEPT_BACK * model.wheels.max_rad_s, 3),
        },
        "guard": {
            "front_m": round(max(0.0, reach.front_m) + _MARGIN_M, 3),
            "rear_m": round(max(0.0, reach.rear_m) + _MARGIN_M, 3),
            "half_width_m": round(reach.half_width_m + _MARGIN_M, 3), "sensor_x_m": round(model.lidar.x_m, 3),
        },
    }
    return laid_over(measured, model.settings)


def vision_table(scenario: Scenario, model: RobotModel, seed: int = 0, mission: str | None = None) -> Table:
    """Return vision.toml of this scenario: target, limits of the robot, mission, and the settings of its file.

    Another `mission` than the scenario's starts with its default options and the waypoints, if any.
    """
    kind = mission or scenario.mission
    waypoints = {"waypoints": [[round(x_m, 4), round(y_m, 4)] for x_m, y_m in goals_seen(scenario, seed)]}
    chosen: Table = {"kind": kind, "options": waypoints if scenario.goals_m else {}}
    under = {"target": {"radius_m": scenario.target.radius_m, "stand_off_m": scenario.stand_off_m},
             "mission": chosen, **_limits(model)}
    given = dict(scenario.vision)
    own = given.pop("mission", {})
    if own and kind == scenario.mission:
        given["mission"] = own
    return laid_over(under, given)


def _limits(model: RobotModel) -> Table:
    """Return the limits of a slow robot for steering."""
    safety = model.settings.get("safety")
    if not isinstance(safety, Mapping):
        return {}
    limits = robot_config(model).safety
    return {
        "steer": {
            "max_linear_mps": limits.max_linear_mps, "max_reverse_mps": round(limits.max_linear_mps / 2, 3),
            "max_angular_rad_s": limits.max_angular_rad_s,
        },
        "latency": {
            "linear_acceleration_mps2": limits.max_acceleration_mps2,
            "angular_acceleration_rad_s2": limits.max_acceleration_rad_s2,
        },
        "search": {"rate_rad_s": limits.max_angular_rad_s},
    }


def robot_config(model: RobotModel, *, auto_arm: bool = False) -> RobotConfig:
    """Return the configuration of the robot as a checked model. Raises ConfigError that names file and key."""
    table = robot_table(model)
    if auto_arm:
        table = laid_over(table, {"safety": {"auto_arm": True}})
    config = _checked(RobotConfig, table, f"robot {model.name}: [settings]")
    if config.ranging is not None:
        _check_sight(config, model)
    return config


def _check_sight(config: RobotConfig, model: RobotModel) -> None:
    """Check the blind zone before the first scan, as the driver process does."""
    lidar = model.lidar
    free = array.array("f", [math.inf] * lidar.rays)
    scan = Ranges(0, math.radians(lidar.first_deg), lidar.increment_rad, lidar.range_min_m, lidar.range_max_m, free)
    try:
        check_blind_zone(config.guard, scan)
    except BlindZoneError as error:
        raise ConfigError(f"robot {model.name}: [settings] {error}") from None


def vision_config(scenario: Scenario, model: RobotModel, seed: int = 0, mission: str | None = None) -> VisionConfig:
    """Return the vision configuration, checked. Raises ConfigError that names scenario and key."""
    table = vision_table(scenario, model, seed, mission)
    return _checked(VisionConfig, table, f"scenario {scenario.name}: [vision]")


def _checked(kind: type[Model], table: Table, whose: str) -> Model:
    try:
        return kind.model_validate(table)
    except ValidationError as error:
        raise ConfigError(f"{whose} {first_problem(error, known=kind.model_fields)}"[:400]) from None
