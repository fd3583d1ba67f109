"""Configuration of the robot service. Pure."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from protocol.config import Config
from protocol.messages import RobotId
from robot_side.guard import GuardConfig
from robot_side.kinematics import DiffDriveConfig
from robot_side.limits import SafetyConfig
from robot_side.stream import StreamConfig

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


class PluginChoice(Config):
    """A device: `kind` is the name of an entry point or `package.module:Name`; `options` are for its own `Config`."""

    kind: str
    options: dict[str, Any] = Field(default_factory=dict)


class RobotConfig(Config):
    """Everything about one robot."""

    robot: RobotId = "r1"
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    """Where peers may connect. Loopback by default; a LAN address such as tcp/0.0.0.0:7447 is a decision."""
    connect: tuple[str, ...] = ()
    """A router or vision box to connect to, beside or instead of listening."""
    camera: PluginChoice = PluginChoice(kind="sim")
    drive: PluginChoice = PluginChoice(kind="sim")
    range_sensor: PluginChoice | None = None
    """None: the simulation's when the drive is the simulation's, else none; kind "none" switches it off."""
    safety: SafetyConfig = SafetyConfig()
    guard: GuardConfig = GuardConfig()
    wheels: DiffDriveConfig = DiffDriveConfig()
    stream: StreamConfig = StreamConfig()
    max_frame_bytes: Annotated[int, Field(ge=1_000, le=1_000_000)] = 400_000
    state_dir: Path = Path("~/.local/state/sightline")
    """Where the STOP latch is kept over restarts."""

    @property
    def ranging(self) -> PluginChoice | None:
        """The range sensor in use."""
        if self.range_sensor is None and self.drive.kind == "sim":
            return self.drive
        return None if self.range_sensor and self.range_sensor.kind == "none" else self.range_sensor
