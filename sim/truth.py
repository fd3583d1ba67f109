"""Describe the true state of a simulated world, for scores and plots. The robot never receives it. Pure."""

import json
from dataclasses import asdict, dataclass
from typing import Self


@dataclass(frozen=True, slots=True)
class Truth:
    """The world at one moment. Positions in meters in the world frame, counter-clockwise positive."""

    t_us: int
    """World time; on the bus, the robot's monotonic clock."""
    x_m: float
    y_m: float
    yaw_rad: float
    """The robot's axle midpoint."""
    linear_mps: float
    angular_rad_s: float
    target_x_m: float
    target_y_m: float
    target_z_m: float
    bearing_rad: float
    """Bearing of the target's center from the camera axis, left positive."""
    distance_m: float
    """Lens to the target's center, horizontally."""
    visible: bool
    """True if the target's center is within the width of the image and no wall hides it."""
    wall_contacts: int
    """Physics steps so far in which the robot touched a wall or another thing in its way."""
    target_contacts: int
    """Physics steps so far in which the robot touched the target."""
    target_contacts_by_robot: int
    """The part of `target_contacts` in which the robot approached the target faster than the target the robot."""
    clearance_m: float | None = None
    """From the robot's body to the nearest obstacle, at most 1; only in scenarios with waypoints."""
    passes: int = 0
    """Number of times that a thing on a path passed between the lens and the target."""
    light: str = ""
    """State of the traffic light, if there is one."""
    past_line_m: float | None = None
    """Distance of the robot's front beyond the stop line of the light, negative before it."""
    lag_us: int = 0
    """Lag of the simulation behind the clock; 0 in lockstep."""

    @property
    def contacts(self) -> int:
        """Return the physics steps so far with any contact but the floor's. Two contacts in one step count twice."""
        return self.wall_contacts + self.target_contacts

    def to_json(self) -> bytes:
        """Return one line of JSON."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_json(cls, data: bytes) -> Self:
        """Read the output of `to_json`. Raises ValueError or TypeError for anything else."""
        return cls(**json.loads(data))
