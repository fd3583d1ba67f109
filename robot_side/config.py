"""Configuration of the robot service. Pure."""

import ipaddress
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator

from sightline.protocol.config import Config
from sightline.protocol.messages import RobotId
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT, with_allowed
from sightline.robot_side.kinematics import DiffDriveConfig
from sightline.robot_side.network.stream import StreamConfig
from sightline.robot_side.safety.guard import GuardConfig
from sightline.robot_side.safety.limits import SafetyConfig


class PluginChoice(Config):
    """A device: `kind` is the name of an entry point or `package.module:Name`; `options` are for its own `Config`."""

    kind: str
    """Name in the table of devices, entry point, or `package.module:Name`."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the device."""


class LegacyConfig(Config):
    """Clients of the legacy protocol. They have no token."""

    allow_from: Annotated[tuple[str, ...], Field(max_length=64)] = ()
    """Permitted addresses and networks, e.g. 192.168.1.7 or 192.168.1.0/24; required beyond loopback."""

    @field_validator("allow_from")
    @classmethod
    def _are_networks(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for text in value:
            try:
                ipaddress.ip_network(text, strict=False)
            except ValueError:
                raise ValueError(f"invalid address {text!r}: expected e.g. 192.168.1.7 or 192.168.1.0/24") from None
        return value


class RobotConfig(Config):
    """Everything about one robot."""

    robot: RobotId = "r1"
    """Robot id, unique at a router."""
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    """Endpoints to which peers may connect; tcp/0.0.0.0:7447 opens the port to the network."""
    connect: tuple[str, ...] = ()
    """Router or vision service to connect to."""
    secure: str = ""
    """Folder of `sightline keys` for mutual TLS and access rules; endpoints are then tls/... or quic/..."""
    camera: PluginChoice = PluginChoice(kind="sim")
    drive: PluginChoice = PluginChoice(kind="sim")
    range_sensor: PluginChoice | None = None
    """Range sensor; default: the simulated sensor with a simulated drive, else no sensor. Kind "none" disables it."""
    battery: PluginChoice | None = None
    """Battery sensor. Without it the robot does not measure its battery."""
    legacy: LegacyConfig = LegacyConfig()
    safety: SafetyConfig = SafetyConfig()
    guard: GuardConfig = GuardConfig()
    wheels: DiffDriveConfig = DiffDriveConfig()
    stream: StreamConfig = StreamConfig()
    max_frame_bytes: Annotated[int, Field(ge=1_000, le=1_000_000)] = 400_000
    """Security limit: the robot does not send larger images."""
    state_dir: Path = Path("~/.local/state/sightline")
    """Folder that stores the STOP latch across restarts."""

    @property
    def doors(self) -> tuple[str, ...]:
        """Return `listen`, with the permitted addresses in the endpoints of the legacy protocol."""
        return tuple(with_allowed(endpoint, self.legacy.allow_from) for endpoint in self.listen)

    @property
    def devices(self) -> dict[str, PluginChoice | None]:
        """Return the device in use for each key, or None if the robot has no such device."""
        return {"camera": self.camera, "drive": self.motors, "range_sensor": self.ranging,
                "battery": self.battery}

    @property
    def motors(self) -> PluginChoice:
        """Return the drive in use. The drive `gpio` also gets the wheel radius, because its table is in meters."""
        if self.drive.kind != "gpio":
            return self.drive
        options = {"wheel_radius_m": self.wheels.wheel_radius_m, **self.drive.options}
        return PluginChoice(kind=self.drive.kind, options=options)

    @property
    def ranging(self) -> PluginChoice | None:
        """Return the range sensor in use."""
        if self.range_sensor is None and self.drive.kind == "sim":
            return self.drive
        return None if self.range_sensor and self.range_sensor.kind == "none" else self.range_sensor
