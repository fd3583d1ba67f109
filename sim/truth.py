"""Describe the true state of a simulated world, for scores and plots. The robot never receives it. Pure."""

import json
from dataclasses import asdict, dataclass
from typing import Self


@dataclass(frozen=True, slots=True)
class Truth:
    """The world at one moment. Positions in metres in the world's frame, counter-clockwise positive."""

    t_us: int
    """The world's time; over the bus the robot's monotonic clock."""
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
    """Of the target's middle from the camera's axis, left positive."""
    distance_m: float
    """Lens to the target's middle, in the horizontal plane."""
    visible: bool
    """The target's middle is within the camera's width and no wall hides it."""
    wall_contacts: int
    """Physics steps so far in which the robot touched a wall or another thing in its way."""
    target_contacts: int
    """Physics steps so far in which the robot touched the target."""
    target_contacts_by_robot: int
    """Those of them in which the robot moved towards the target faster than the target towards it."""
    clearance_m: float | None = None
    """From the robot's body to the nearest obstacle, at most 1; only where it is sent to waypoints."""
    passes: int = 0
    """How often so far a thing on a path went through between the lens and the target."""
    light: str = ""
    """What the traffic light shows, if there is one."""
    past_line_m: float | None = None
    """How far the robot's front is beyond the light's stop line, negative before it."""
    lag_us: int = 0
    """How far the simulation is behind the clock; 0 in lockstep."""

    @property
    def contacts(self) -> int:
        """Physics steps so far in which the robot touched anything but the floor (both at once count twice)."""
        return self.wall_contacts + self.target_contacts

    def to_json(self) -> bytes:
        """One line of JSON."""
        return json.dumps(asdict(self)).encode()

    @classmethod
    def from_json(cls, data: bytes) -> Self:
        """Read what `to_json` wrote. Raises ValueError or TypeError for anything else."""
        return cls(**json.loads(data))
