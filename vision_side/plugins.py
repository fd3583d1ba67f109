"""Options of detectors and missions, merged over the sections of the vision configuration. Pure."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from sightline.protocol.config import config_model
from sightline.vision_side.config import VisionConfig


def shared_options(plugin: Any, options: Mapping[str, Any], config: VisionConfig) -> dict[str, Any]:
    """Merge `options` over the sections of `config` that the plug-in's `Config` has with the same name and type.

    Such sections are, for example, `target`, `hsv` and `boxes`.
    """
    merged: dict[str, Any] = dict(options)
    settings = config_model(plugin)
    for name, field in settings.model_fields.items() if settings else ():
        section = getattr(config, name, None)
        if not isinstance(section, BaseModel) or field.annotation is not type(section):
            continue
        given = options.get(name, {})
        merged[name] = section.model_dump() | dict(given) if isinstance(given, Mapping) else given
    return merged
