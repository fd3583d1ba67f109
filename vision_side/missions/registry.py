"""Find a mission by name and build it with its configuration. Shell (imports plug-ins).

A name is an entry point of `sightline.missions`. A configuration or command line may also name `package.module:Name`.
A section of the vision configuration (`target`, `track`, `steer`, `latency`, `search`, `boxes`) is the default of a
section of the mission's `Config` with the same name and type. The options of the mission override it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from sightline.protocol.config import PluginRegistry, config_model
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import CameraModel, MissionRequest
from sightline.vision_side.config import TargetConfig, VisionConfig
from sightline.vision_side.detect.port import is_followable
from sightline.vision_side.missions.port import Mission
from sightline.vision_side.plugins import shared_options

REGISTRY: Final = PluginRegistry("mission", "sightline.missions")


@dataclass(frozen=True, slots=True)
class MissionSpec:
    """A mission with its configuration. It is built for each session of the robot."""

    name: str
    plugin: Any
    config: Any

    @property
    def wants_scan(self) -> bool:
        """Return True if it uses range scans."""
        return bool(getattr(self.plugin, "wants_scan", False))

    @property
    def needs_camera(self) -> bool:
        """Return True if it must start again with another camera model."""
        return bool(getattr(self.plugin, "needs_camera", True))

    @property
    def scales(self) -> bool:
        """Return True if it continues with images of another size of the same lens."""
        return bool(getattr(self.plugin, "scales", False))

    @property
    def label(self) -> str:
        """The label of its targets, from `label` or `target` of its configuration; empty for any."""
        own, target = getattr(self.config, "label", None), getattr(self.config, "target", None)
        if isinstance(own, str):
            return own
        return target.label if isinstance(target, TargetConfig) else ""

    def goes_by(self, label: str) -> bool:
        """Return True if it may use detections with this label."""
        if isinstance(getattr(self.config, "label", None), str):
            return self.label in ("", label)
        has_target = isinstance(getattr(self.config, "target", None), TargetConfig)
        return is_followable(label, self.label) if has_target else True

    def build(self, camera: CameraModel) -> Mission:
        """Create a new mission in its initial state."""
        mission: Mission = self.plugin(self.config, camera)
        return mission


def configured_mission(config: VisionConfig) -> MissionSpec:
    """Return the mission of `config.mission`. Raises ConfigError for an invalid choice."""
    return mission_spec(config.mission.kind, _own_options(config.mission.kind, config), config)


def _own_options(kind: str, config: VisionConfig) -> dict[str, Any]:
    """Return the options of `config` for the mission `kind`."""
    own = config.mission.options if kind == config.mission.kind else {}
    return {**config.missions.get(kind, {}), **own}


def check_missions(config: VisionConfig) -> None:
    """Raise ConfigError for an error in the configured mission, or in the options of missions for later requests.
    Waypoints are not checked, because they come with the request."""
    configured_mission(config)
    for kind, options in config.missions.items():
        settings = config_model(REGISTRY.load(kind))
        missing = {"waypoints": [(0.0, 0.0)]} if settings and "waypoints" in settings.model_fields else {}
        mission_spec(kind, {**missing, **options}, config)


def requested_mission(request: MissionRequest, config: VisionConfig) -> MissionSpec:
    """Return the mission of a request. Its options override those of `config` for the same mission.

    Raises ConfigError for an unknown mission or a wrong option.
    """
    REGISTRY.load(request.name, takes_classes=False)  # the wire's model rejects it too; a message names no code
    options = _own_options(request.name, config)
    for name, value in request.options.items():
        _lay(options, name.split("."), value)
    if request.waypoints:
        options["waypoints"] = request.waypoints
    return mission_spec(request.name, options, config)


def _lay(options: dict[str, Any], path: list[str], value: Any) -> None:
    """Set `value` at `path` in `options`. It copies tables instead of changing them."""
    for name in path[:-1]:
        inner = options.get(name)
        options[name] = options = dict(inner) if isinstance(inner, Mapping) else {}
    options[path[-1]] = value


def mission_spec(kind: str, options: Mapping[str, Any], config: VisionConfig) -> MissionSpec:
    """Return the mission called `kind` with its checked configuration.

    Raises ConfigError, one line, for an unknown kind (nearest named), a missing package or a wrong option.
    """
    plugin = REGISTRY.load(kind)
    spec = MissionSpec(kind, plugin, REGISTRY.settings(kind, plugin, shared_options(plugin, options, config)))
    if not callable(getattr(plugin, "step", None)):
        raise ConfigError(f"mission {kind!r} has no method step(): docs/how-to/write-a-mission.md")
    return spec
