"""Finds a device class by entry-point name or `package.module:Name`, and builds it with its own `Config`. Shell."""

import difflib
import importlib
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ValidationError

from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import PluginChoice

_WORDS: Final = {"cameras": "camera", "drives": "drive", "range_sensors": "range sensor"}


def build_device(group: str, choice: PluginChoice) -> Any:
    """The device `choice` names, from the entry points of `sightline.<group>`.

    Raises ConfigError for an unknown kind (nearest named), a missing package or a wrong option; HardwareError as the
    device itself does.
    """
    plugin, config = load_device(group, choice)
    return plugin(config)


def load_device(group: str, choice: PluginChoice) -> tuple[Any, Any]:
    """The class and its checked `Config`, without touching the device. Raises ConfigError."""
    plugin = _load(group, choice.kind)
    try:
        return plugin, plugin.Config.model_validate(choice.options)
    except ValidationError as error:
        raise ConfigError(f"{_WORDS[group]} {choice.kind!r}: {_problem(plugin.Config, error)}") from None


def _problem(config: type[BaseModel], error: ValidationError) -> str:
    """A misspelt option before a missing one: it is usually both."""
    problems = sorted(error.errors(include_url=False), key=lambda one: one["type"] != "extra_forbidden")
    where = ".".join(str(part) for part in problems[0]["loc"])
    if problems[0]["type"] == "extra_forbidden":
        return f"unknown option {where!r}; it takes {', '.join(config.model_fields)}"
    said = "is missing" if problems[0]["type"] == "missing" else problems[0]["msg"].removeprefix("Value error, ")
    return f"option {where!r}: {said}" if where else said


def _load(group: str, kind: str) -> Any:
    known = {entry.name: entry for entry in entry_points(group=f"sightline.{group}")}
    try:
        if kind in known:
            return known[kind].load()
        if ":" in kind:
            if str(Path.cwd()) not in sys.path:  # a class of one's own lies where the robot is started
                sys.path.append(str(Path.cwd()))  # last: a file there is not to stand in for what is installed
            module, _, name = kind.partition(":")
            return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:  # the last two: `:Name`, `.module:Name`
        raise ConfigError(f"{_WORDS[group]} {kind!r} cannot be loaded: {error}") from None
    nearest = difflib.get_close_matches(kind, known, n=1)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    there_are = ", ".join(sorted(known))
    raise ConfigError(f"no {_WORDS[group]} called {kind!r}{hint}; there are {there_are}, or package.module:Name")
