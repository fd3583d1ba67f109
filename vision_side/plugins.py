"""Options of detectors and missions, laid over the sections of the vision service's configuration. Pure."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from sightline.protocol.config import config_model
from sightline.vision_side.config import VisionConfig


def shared_options(plugin: Any, options: Mapping[str, Any], config: VisionConfig) -> dict[str, Any]:
    """Merge `options` over each section of `config` that the plug-in's `Config` has by name and type.

    Such a section is, for example, `target`, `hsv` or `boxes`.
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
