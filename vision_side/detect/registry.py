"""Find a detector by name and build it with its wrappers. Shell (imports plug-ins).

A name is an entry point of `sightline.detectors`. A configuration or command line may also name `package.module:Name`.
The text after the name is the option `address`: "ball.onnx" for `onnx:ball.onnx`, all of `oip+http://box/ball`.
A `Config` gets the sections and fields of the vision configuration that have the same name.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from sightline.protocol.config import PluginRegistry, config_model, warn_renamed
from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.filters import ColorFilter, LabelFilter, TrackIds
from sightline.vision_side.detect.plugin_calls import OLD_NOTICES, labels_of, plugin_guard
from sightline.vision_side.detect.port import COLOR_LABEL, Detector, NoDetector
from sightline.vision_side.detect.remote.client import EXAMPLES
from sightline.vision_side.missions.registry import MissionSpec, check_missions, configured_mission
from sightline.vision_side.plugins import shared_options

BOXES: Final = "boxes"
"""No local detector: another client publishes the boxes, see vision_side/serving/service.py."""
REGISTRY: Final = PluginRegistry("detector", "sightline.detectors", (BOXES,))
_FILLED: Final = ("robot", "connect", "listen", "secure", "max_frame_bytes", "max_pixels")
_MOST_NAMED: Final = 12
_OF_DETECTOR: Final = ("device", "deadline_s")


def configured_detector(config: VisionConfig) -> Detector:
    """Create the detector of `config.detector` with its filters, fallback and shadow.

    Raises ConfigError for an unknown detector or a wrong option, HardwareError for an unavailable device.
    """
    one = config.detector
    if one.kind == BOXES:
        _check_no_detector(config)
        return NoDetector()
    check_device(config)
    _check_fallback(config)
    detector = _built(one.kind, one.options, config)
    if one.fallback:
        from sightline.vision_side.detect.remote.fallback import Fallback

        detector = Fallback(detector, _built(one.fallback, {}, config), max_pixels=config.max_pixels)
    detector = _narrowed(detector, config)
    if one.shadow:
        from sightline.vision_side.detect.shadow import ShadowDetector

        second = _narrowed(_built(one.shadow, one.shadow_options, config), config)
        detector = ShadowDetector(detector, second, one.shadow, config.max_pixels)
    return detector


def _built(kind: str, options: Mapping[str, Any], config: VisionConfig) -> Detector:
    """Create one of the configured detectors. Raises ConfigError, also for a configured label that it never gives."""
    detector = build_detector(kind, options, config)
    _check_used_labels(kind, labels_of(detector), config)
    return detector


def _check_no_detector(config: VisionConfig) -> None:
    """Raise ConfigError for a setting of local detectors."""
    one = config.detector
    given = ["device"] if one.device != "auto" else []
    given += [name for name in ("options", "fallback", "shadow", "shadow_options", "labels", "only_color", "tracked")
              if getattr(one, name)]
    if given:
        raise ConfigError(f"detector.{given[0]} goes with a local detector; {BOXES!r} is remote")


def _narrowed(detector: Detector, config: VisionConfig) -> Detector:
    one = config.detector
    if one.labels:
        detector = LabelFilter(detector, one.labels)
    if one.only_color:
        detector = ColorFilter(detector, config.hsv.ranges)
    return TrackIds(detector) if one.tracked else detector


def _check_used_labels(kind: str, known: Sequence[str], config: VisionConfig) -> None:
    """Raise ConfigError for a label of the filter or of the mission that the detector does not list."""
    _check_labels("detector.labels", kind, config.detector.labels, known)
    if known:
        check_mission_label(configured_mission(config), kind, known)


def check_mission_label(mission: MissionSpec, kind: str, known: Sequence[str]) -> None:
    """Raise ConfigError for a mission whose label the detector does not list, if it lists any."""
    if mission.label:
        _check_labels(f"mission {mission.name!r}", kind, (mission.label,), known)


def _check_labels(place: str, kind: str, wanted: Sequence[str], known: Sequence[str]) -> None:
    """Raise ConfigError for a label that is not in the detector's list `known`, if it is not empty."""
    for label in wanted if known else ():
        if label not in known:
            nearest = difflib.get_close_matches(label, known, n=1)
            hint = f"; did you mean {nearest[0]!r}?" if nearest else f"; it gives {', '.join(known[:_MOST_NAMED])}"
            hint = "; only a color detector gives it, e.g. --detector hsv" if label == COLOR_LABEL else hint
            raise ConfigError(f"{place}: {kind} has no label {label!r}{hint}")


def waits_for_service(config: VisionConfig) -> bool:
    """Return True if a configured detector waits for another service and should not delay other robots."""
    one = config.detector
    kinds = [kind for kind in (one.kind, one.fallback, one.shadow) if kind and kind != BOXES]
    return any(getattr(REGISTRY.load(split_kind(kind)[0]), "waits", False) for kind in kinds)


def _check_fallback(config: VisionConfig) -> None:
    """Raise ConfigError for a fallback that is remote itself."""
    kind = config.detector.fallback
    if kind and (kind == BOXES or getattr(REGISTRY.load(split_kind(kind)[0]), "waits", False)):
        raise ConfigError(f"detector.fallback {kind!r} is remote; choose a local detector, e.g. hsv")


def check_takes_pictures(kind: str) -> None:
    """Raise ConfigError for a detector that only receives boxes of a robot's frames, for a run without a robot."""
    if kind != BOXES and getattr(REGISTRY.load(split_kind(kind)[0]), "only_receives", False):
        raise ConfigError(f"detector {kind!r} receives boxes of a robot's own frames, and its service serves no "
                          "robot here; name the detector that the service serves")


def check_device(config: VisionConfig) -> None:
    """Raise ConfigError for a device if no configured detector has a choice of devices."""
    one = config.detector
    if one.device == "auto":
        return
    kinds = [kind for kind in (one.kind, one.fallback, one.shadow) if kind]
    if not any(_has_field(kind, "device") for kind in kinds):
        raise ConfigError(f"detector {one.kind!r} has no device to choose: --device {one.device} is for detectors "
                          "that run a model here, e.g. --detector onnx")


def _has_field(kind: str, field: str) -> bool:
    settings = config_model(REGISTRY.load(split_kind(kind)[0]))
    return settings is not None and field in settings.model_fields


def split_kind(kind: str) -> tuple[str, str]:
    """Split a kind into name and address. `package.module:Name` is a name without an address.

    Raises ConfigError for a file without the name of a detector, and for a colon without an address.
    """
    name, colon, rest = kind.partition(":")
    if name not in REGISTRY.names():
        if Path(kind).is_file():
            if kind.endswith(".py"):
                raise ConfigError(f"detector {kind!r} is a file of Python: write {Path(kind).stem}:NAME for its class "
                                  "NAME, and start the command in its folder")
            raise ConfigError(f"detector {kind!r} is a file: write onnx:{kind}, or torch:{kind} for a model of PyTorch")
        return kind, ""
    if colon and not rest:
        example = getattr(REGISTRY.load(name), "example", "")  # of a detector that needs a model
        wanted = EXAMPLES.get(name) or (f"e.g. {name}:{example}" if example else name)
        raise ConfigError(f"detector {kind!r} has nothing after its colon; write {wanted}")
    return name, kind if rest.startswith("//") else rest


def build_detector(kind: str, options: Mapping[str, Any], config: VisionConfig) -> Detector:
    """Create the detector called `kind`, without wrappers.

    Raises ConfigError, one line, for an unknown kind (nearest named), a missing package or a wrong option, and
    HardwareError for an unavailable device.
    """
    plugin, settings = _checked(kind, options, config)
    with plugin_guard(f"{kind}, when it is made,"):
        detector: Detector = plugin(settings)
    return detector


def check_vision(config: VisionConfig) -> None:
    """Check the detectors and missions of `config` before any is built. Raises ConfigError."""
    check_missions(config)
    one = config.detector
    if one.kind == BOXES:
        _check_no_detector(config)
        return
    check_device(config)
    _check_fallback(config)
    for kind, options in ((one.kind, one.options), (one.fallback, {}), (one.shadow, one.shadow_options)):
        if kind:
            _check_used_labels(kind, check_choice(kind, options, config), config)


def check_choice(kind: str, options: Mapping[str, Any], config: VisionConfig) -> Sequence[str]:
    """Check name, options and model before the detector is built. Raises ConfigError.

    Returns:
        The labels of its model, empty if they are unknown.
    """
    plugin, settings = _checked(kind, options, config)
    read_model: Callable[[Any], Any] | None = getattr(plugin, "read_model", None)
    if read_model is None:
        return ()
    with plugin_guard(f"{kind}, when its model is read,"):
        labels: Sequence[str] = getattr(read_model(settings), "labels", ())
        return labels


def _checked(kind: str, options: Mapping[str, Any], config: VisionConfig) -> tuple[Any, Any]:
    """Return the plug-in and its checked `Config`."""
    if kind == BOXES:
        raise ConfigError(f"{BOXES!r} is remote; choose a local detector, e.g. hsv")
    name, address = split_kind(kind)
    plugin = REGISTRY.load(name)
    settings = config_model(plugin)
    fields = settings.model_fields if settings else {}
    if address and "address" not in fields:
        raise ConfigError(f"detector {name!r} takes nothing after its name, not {address!r}")
    given: dict[str, Any] = {one: getattr(config, one) for one in _FILLED if one in fields}
    given |= {one: getattr(config.detector, one) for one in _OF_DETECTOR if one in fields}
    given |= {"address": address} if address else {}
    if name in EXAMPLES and "address" not in {**given, **options}:
        raise ConfigError(f"detector {name!r} has no address: write e.g. {EXAMPLES[name]}")
    own = REGISTRY.settings(name, plugin, shared_options(plugin, given | dict(options), config))
    if not callable(getattr(plugin, "detect", None)):
        raise ConfigError(f"detector {kind!r}: the class has no method detect; see docs/how-to/write-a-detector.md")
    if hasattr(plugin, OLD_NOTICES) and not hasattr(plugin, "notices"):
        warn_renamed(f"detector {kind!r}: method", OLD_NOTICES, "notices")
    return plugin, own
