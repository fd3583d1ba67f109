"""Builds the robot's devices: each a plug-in, found by entry-point name or `package.module:Name`. Shell."""

from typing import Any, Final

from sightline.protocol.config import PluginRegistry
from sightline.robot_side.config import PluginChoice

_REGISTRIES: Final = {
    group: PluginRegistry(noun, f"sightline.{group}")
    for group, noun in (("cameras", "camera"), ("drives", "drive"), ("range_sensors", "range sensor"))
}


def build_device(group: str, choice: PluginChoice) -> Any:
    """The device `choice` names, from the entry points of `sightline.<group>`.

    Raises:
        ConfigError: for an unknown kind (nearest named), a missing package or a wrong option.
        HardwareError: as the device itself does.
    """
    plugin, config = load_device(group, choice)
    return plugin(config)


def load_device(group: str, choice: PluginChoice) -> tuple[Any, Any]:
    """The class and its checked `Config`, without touching the device. Raises ConfigError."""
    registry = _REGISTRIES[group]
    plugin = registry.load(choice.kind)
    return plugin, registry.settings(choice.kind, plugin, choice.options)
