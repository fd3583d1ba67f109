"""The device groups of the robot. A plug-in is found by entry point or `package.module:Name`. Shell."""

import logging
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from sightline.protocol.config import PluginRegistry
from sightline.protocol.errors import ConfigError, HardwareError, SightlineError
from sightline.protocol.log import error_text, report_ending
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.ports import Battery, Camera, Drive, RangeSensor

_log: Final = logging.getLogger(__name__)

Port = TypeVar("Port")


@dataclass(frozen=True)
class DeviceGroup(Generic[Port]):
    """One kind of device: its key in the robot's configuration, its port, its entry points."""

    key: str
    port: type[Any]
    entry_points: str
    also: tuple[str, ...] = ()
    """Further kinds that the configuration takes, for the error text."""

    def build(self, choice: PluginChoice, *, is_last: bool = True) -> Port:
        """Create the device that `choice` names.

        Args:
            choice: kind and options.
            is_last: True if an exception of the device ends the program, so that its traceback is logged here.

        Raises:
            ConfigError: for an unknown kind (nearest named), a missing package, method or wrong option.
            HardwareError: from the device, or for any other exception of it.
            KeyboardInterrupt: with `is_last`, from Ctrl-C. Other processes ignore or block its signal.
        """
        plugin, config = self.load(choice)
        try:
            device: Port = plugin(config)
        except SightlineError:
            raise
        except BaseException as error:
            if is_last and isinstance(error, KeyboardInterrupt):  # usually Ctrl-C
                _log.warning("interrupted while the %s %s opened", self.noun, choice.kind)
                raise
            if is_last:
                report_ending(self.noun, error)
            raise self.failed(choice, error) from error
        for name in self.methods:
            if not callable(getattr(device, name, None)):
                raise ConfigError(f"{self.noun} {choice.kind!r} has no method {name}(): docs/how-to/add-a-device.md")
        return device

    def failed(self, choice: PluginChoice, error: BaseException) -> HardwareError:
        """Return the error for an exception of the device."""
        return HardwareError(f"{self.noun} {choice.kind!r} raised {type(error).__name__}: {error_text(error)}")

    @property
    def methods(self) -> list[str]:
        """List the methods that a device must have. The guardian of a drive checks `zero`."""
        names = (name for name, one in vars(self.port).items() if callable(one) and name[0] != "_")
        return [name for name in names if name not in ("zero", "close")]

    @property
    def noun(self) -> str:
        """Return the name of this kind of device for texts."""
        return self.key.replace("_", " ")

    def load(self, choice: PluginChoice) -> tuple[Any, Any]:
        """Load the class and check its `Config`, without opening the device. Raises ConfigError."""
        registry = PluginRegistry(self.noun, self.entry_points, self.also)
        plugin = registry.load(choice.kind)
        return plugin, registry.settings(choice.kind, plugin, choice.options)


CAMERAS: Final = DeviceGroup[Camera]("camera", Camera, "sightline.cameras")
DRIVES: Final = DeviceGroup[Drive]("drive", Drive, "sightline.drives")
RANGE_SENSORS: Final = DeviceGroup[RangeSensor]("range_sensor", RangeSensor, "sightline.range_sensors", ("none",))
BATTERIES: Final = DeviceGroup[Battery]("battery", Battery, "sightline.batteries")

DEVICE_GROUPS: Final[tuple[DeviceGroup[Any], ...]] = (CAMERAS, DRIVES, RANGE_SENSORS, BATTERIES)
