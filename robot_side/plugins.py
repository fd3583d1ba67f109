"""Finds a device class by entry-point name or `package.module:Name`, and builds it with its own `Config`. Shell."""

import difflib
import importlib
from importlib.metadata import entry_points
from typing import Any

from pydantic import ValidationError

from protocol.errors import ConfigError
from robot_side.config import PluginChoice


def build(group: str, choice: PluginChoice) -> Any:
    """The device `choice` names, from the entry points of `sightline.<group>`.

    Raises ConfigError for an unknown kind (nearest named), a missing package or a wrong option; HardwareError as the
    device itself does.
    """
    plugin = _load(group, choice.kind)
    try:
        config = plugin.Config.model_validate(choice.options)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"option {where!r} of {group} {choice.kind!r}: {first['msg']}") from None
    return plugin(config)


def _load(group: str, kind: str) -> Any:
    known = {entry.name: entry for entry in entry_points(group=f"sightline.{group}")}
    try:
        if kind in known:
            return known[kind].load()
        if ":" in kind:
            module, _, name = kind.partition(":")
            return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"{group} {kind!r} cannot be loaded: {error}") from None
    nearest = difflib.get_close_matches(kind, known, n=1)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    raise ConfigError(f"no {group} called {kind!r}{hint} Known: {', '.join(sorted(known))}, or package.module:Name")
