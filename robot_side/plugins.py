"""The robot's kinds of devices, each a plug-in found by entry-point name or `package.module:Name`. Shell."""

from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from sightline.protocol.config import PluginRegistry
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.ports import Battery, Camera, Drive, RangeSensor

Port = TypeVar("Port")


@dataclass(frozen=True)
class DeviceGroup(Generic[Port]):
    """One kind of device: its key in the robot's configuration, what it must be able to do, its entry points."""

    key: str
    port: type[Any]
    entry_points: str

    def build(self, choice: PluginChoice) -> Port:
        """Create the device that `choice` names.

        Raises:
            ConfigError: for an unknown kind (nearest named), a missing package or a wrong option.
            HardwareError: as the device itself does.
        """
        plugin, config = self.load(choice)
        device: Port = plugin(config)
        return device

    def load(self, choice: PluginChoice) -> tuple[Any, Any]:
        """Load the class and check its `Config`, without opening the device. Raises ConfigError."""
        registry = PluginRegistry(self.key.replace("_", " "), self.entry_points)
        plugin = registry.load(choice.kind)
        return plugin, registry.settings(choice.kind, plugin, choice.options)


CAMERAS: Final = DeviceGroup[Camera]("camera", Camera, "sightline.cameras")
DRIVES: Final = DeviceGroup[Drive]("drive", Drive, "sightline.drives")
RANGE_SENSORS: Final = DeviceGroup[RangeSensor]("range_sensor", RangeSensor, "sightline.range_sensors")
BATTERIES: Final = DeviceGroup[Battery]("battery", Battery, "sightline.batteries")

DEVICE_GROUPS: Final[tuple[DeviceGroup[Any], ...]] = (CAMERAS, DRIVES, RANGE_SENSORS, BATTERIES)
