"""Loads a plug-in by name and validates its configuration; for missions and detectors. Shell (imports).

Names are those of a built-in table, those of a group of entry points, or, from a configuration or a command line only,
`package.module:Name`. A plug-in's `Config` that has a section of vision's configuration by name and type (`target`,
`hsv`, `boxes`) begins with that section; its options lie over it.
"""

import difflib
import importlib
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ValidationError

from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.plugin_calls import PLUGIN_ERRORS

LONGEST_DETAIL: Final = 160
_CLASS: Final = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*")
"""`package.module:Name`."""


@dataclass(frozen=True, slots=True)
class PluginRegistry:
    """One kind of plug-in: what it is called, what is built in, who else may be installed."""

    noun: str
    built_in: Mapping[str, str]
    group: str

    def names(self) -> list[str]:
        """Every name that `load` knows here."""
        return sorted({*self.built_in, *(entry.name for entry in entry_points(group=self.group))})

    def load(self, kind: str) -> Any:
        """What is called `kind`. Raises ConfigError, one line, for an unknown one (nearest named) and a broken one."""
        where = self.built_in.get(kind)
        others = {} if where else {entry.name: entry for entry in entry_points(group=self.group)}
        try:
            if kind in others:
                return others[kind].load()
            if where is not None or _CLASS.fullmatch(kind):
                return _imported(where or kind)
        except PLUGIN_ERRORS as error:  # in a plug-in's own import
            hint = "" if where or kind in others else self._hint(kind)
            why = str(error) or type(error).__name__
            raise ConfigError(f"{self.noun} {kind!r} cannot be loaded: {why}"[:LONGEST_DETAIL] + hint) from None
        hint, there = self._hint(kind), ", ".join(self.names())
        raise ConfigError(f"no {self.noun} called {kind!r}{hint}; there are {there}, or package.module:Name")

    def _hint(self, kind: str) -> str:
        """Which name is nearest; what stands after one is no part of it."""
        nearest = difflib.get_close_matches(kind.partition(":")[0], self.names(), n=1)
        return f"; did you mean {nearest[0]!r}?" if nearest else ""

    def settings(self, kind: str, plugin: Any, options: Mapping[str, Any], config: VisionConfig) -> Any:
        """The checked `Config` of `plugin`. Raises ConfigError, one line, for a wrong option."""
        settings = config_model(plugin)
        if settings is None:
            raise ConfigError(f"{self.noun} {kind!r}: {plugin!r} has no pydantic model called Config; see "
                              f"docs/{self.noun}s.md")
        try:
            return settings.model_validate(_merged(settings, options, config))
        except ValidationError as error:
            raise ConfigError(f"{self.noun} {kind!r}: {_problem(settings, error)}"[:LONGEST_DETAIL]) from None


def config_model(plugin: Any) -> type[BaseModel] | None:
    """The class's own `Config`."""
    settings = getattr(plugin, "Config", None)
    return settings if isinstance(settings, type) and issubclass(settings, BaseModel) else None


def _merged(settings: type[BaseModel], options: Mapping[str, Any], config: VisionConfig) -> dict[str, Any]:
    """The sections of vision's configuration that the plug-in shares, with its options laid over them."""
    merged: dict[str, Any] = dict(options)
    for name, field in settings.model_fields.items():
        section = getattr(config, name, None)
        if not isinstance(section, BaseModel) or field.annotation is not type(section):
            continue
        given = options.get(name, {})
        merged[name] = section.model_dump() | dict(given) if isinstance(given, Mapping) else given
    return merged


def _problem(settings: type[BaseModel], error: ValidationError) -> str:
    """A misspelt option before a missing one: it is usually both."""
    problems = sorted(error.errors(include_url=False), key=lambda one: one["type"] != "extra_forbidden")
    first = problems[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"unknown option {where!r}; it takes {', '.join(settings.model_fields) or 'none'}"
    if first["type"] == "missing":
        return f"option {where!r} is missing"
    return f"option {where!r}: {first['msg']}"


def _imported(path: str) -> Any:
    if str(Path.cwd()) not in sys.path:  # a class of one's own lies where vision is started
        sys.path.append(str(Path.cwd()))  # last: a file there is not to stand in for what is installed
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
