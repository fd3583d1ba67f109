"""The base class of configurations, the loader of plug-ins, and one-line validation errors. Shell (imports plug-ins).

The name of a plug-in is an entry point of its group. A configuration or command line may also name
`package.module:Name`. A message never names code.
"""

import difflib
import linecache
import logging
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.machinery import PathFinder
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Final

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from sightline.protocol.errors import ConfigError, SightlineError, home_path
from sightline.protocol.log import error_text, report_ending

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

PLUGIN_ERRORS: Final = (Exception, SystemExit)
"""Errors of plug-in code. A `sys.exit` in a plug-in must end only the plug-in, not the service."""
_LONGEST_DETAIL: Final = 160
_MAX_FILE_BYTES: Final = 1_000_000
_TYPE_NAMES: Final = {"model_type": "a table", "dict_type": "a table", "tuple_type": "a list", "list_type": "a list",
                      "string_type": "text"}
"""Type of a pydantic error -> the term in TOML, because the messages of pydantic name Python types and classes."""
_log: Final = logging.getLogger(__name__)
_HERE: Final = Path(__file__).resolve().parent
_CLASS: Final = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*")
_OLD_PACKAGES: Final = ("protocol", "robot_side", "vision_side", "sim", "operator_side", "benchmarks")
"""Packages that were at the top level before they moved below `sightline`."""
_OLD_MODULE: Final = re.compile(rf"(?<![\w.])((?:{'|'.join(_OLD_PACKAGES)})(?:\.\w+)*)")


class Config(BaseModel):
    """Base of configurations. Frozen; unknown keys, nan and inf are errors. Names contain units, fields limits."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    renamed_keys: ClassVar[Mapping[str, str]] = {}
    """Old key -> new key. The last release used the old keys. They are accepted for one release, with one warning."""

    @model_validator(mode="before")
    @classmethod
    def _rename_keys(cls, given: Any) -> Any:
        if not isinstance(given, dict) or cls.renamed_keys.keys().isdisjoint(given):
            return given
        for old in cls.renamed_keys.keys() & given.keys():
            warn_renamed("configuration key", old, cls.renamed_keys[old])
        return {key: value for key, value in given.items() if key not in cls.renamed_keys} | {
            new: given[old] for old, new in cls.renamed_keys.items() if old in given
        }


def file_text(path: str | Path) -> str:
    """Return the text of a TOML file. Raises OSError, and ConfigError for a file that is too large or not UTF-8."""
    with home_path(path).open("rb") as file:
        data = file.read(_MAX_FILE_BYTES + 1)
    if len(data) > _MAX_FILE_BYTES:
        raise ConfigError(f"{path}: more than {_MAX_FILE_BYTES} bytes; name a TOML file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: not a text file in UTF-8; save it as UTF-8") from None


@cache
def warn_renamed(noun: str, old: str, new: str) -> None:
    """Log once that an accepted name has changed."""
    _log.warning("%s %r is now %r; rename it", noun, old, new)


def first_problem(error: ValidationError, noun: str = "", known: Iterable[str] = (), whole: str = "") -> str:
    """Format the first problem of a validation as one line.

    Args:
        noun: the term for a field, e.g. "option". Without it the line begins with the place of the field and a colon.
        known: the valid names, for an unknown field.
        whole: the place of a problem without its own place.
    """
    # A misspelled field comes before a missing one, because it usually causes both errors.
    problems = error.errors(include_url=False, include_context=False)
    first = min(problems, key=lambda one: one["type"] != "extra_forbidden")
    place = ".".join(str(part) for part in first["loc"]) or whole
    if first["type"] == "extra_forbidden":
        return f"unknown {noun or 'key'} {place!r}; it takes {', '.join(known) or 'none'}"
    if first["type"] == "missing":
        return f"{noun or 'key'} {place!r} is missing"
    type_name = _TYPE_NAMES.get(first["type"])
    what = f"expected {type_name}" if type_name else first["msg"].removeprefix("Value error, ")
    if not place:
        return what
    return f"{noun} {place!r}: {what}" if noun else f"{place}: {what}"


@cache
def _entries(group: str) -> "dict[str, EntryPoint]":
    from importlib.metadata import entry_points  # slow to import, and the operator's STOP needs no plug-in

    return {entry.name: entry for entry in entry_points(group=group)}


@dataclass(frozen=True, slots=True)
class PluginRegistry:
    """One kind of plug-in: its term, and its group of entry points."""

    noun: str
    group: str
    also: tuple[str, ...] = ()
    """Further names for the error text, which `load` does not accept."""

    def names(self) -> list[str]:
        """Return every name that `load` accepts."""
        return sorted(_entries(self.group))

    def load(self, kind: str, *, takes_classes: bool = True) -> Any:
        """Import the plug-in `kind`, or with `takes_classes` also the class `package.module:Name`.

        Raises ConfigError, one line, for an unknown or a broken plug-in.
        """
        entry = _entries(self.group).get(kind)
        try:
            with _old_packages_missing():
                if entry is not None:
                    return entry.load()
                if takes_classes and _CLASS.fullmatch(kind):
                    return _imported(kind)
        except PLUGIN_ERRORS as error:  # from the import of a plug-in
            if not isinstance(error, ImportError | AttributeError):  # these errors name the missing part
                report_ending(self.noun, error)
            hint = "" if entry is not None else self._hint(kind) or _folder_hint(error, kind)
            raise ConfigError(f"{self.noun} {kind!r} cannot be loaded: {_why(error, kind)}{hint}") from None
        there = f"there are {', '.join(sorted((*self.names(), *self.also)))}"
        there += ", or package.module:Name" if takes_classes else ""
        raise ConfigError(f"no {self.noun} called {kind!r}{self._hint(kind)}; {there}")

    def _hint(self, kind: str) -> str:
        """Return the nearest name. Text after a colon is not part of a name."""
        nearest = difflib.get_close_matches(kind.partition(":")[0], (*self.names(), *self.also), n=1)
        return f"; did you mean {nearest[0]!r}?" if nearest else ""

    def settings(self, kind: str, plugin: Any, options: Mapping[str, Any]) -> Any:
        """Check the options of `plugin` and return its `Config`. Raises ConfigError for an invalid option."""
        settings = config_model(plugin)
        if settings is None:
            raise ConfigError(f"{self.noun} {kind!r}: not a class with a pydantic model called Config")
        try:
            return settings.model_validate(options)
        except ValidationError as error:
            problem = first_problem(error, "option", settings.model_fields)
            raise ConfigError(f"{self.noun} {kind!r}: {problem}"[:_LONGEST_DETAIL]) from None


def config_model(plugin: Any) -> type[BaseModel] | None:
    """Return the `Config` of the class, or None if it has no `Config`."""
    settings = getattr(plugin, "Config", None)
    return settings if isinstance(settings, type) and issubclass(settings, BaseModel) else None


def _imported(path: str) -> Any:
    import importlib

    if str(Path.cwd()) not in sys.path:  # a user's class is in the folder where the service starts
        sys.path.append(str(Path.cwd()))  # last, so that a file there does not replace an installed module
    module, _, name = path.partition(":")
    found = importlib.import_module(module)
    if not hasattr(found, name):
        nearest = difflib.get_close_matches(name, dir(found), n=1)
        hint = f"; did you mean {module}:{nearest[0]}?" if nearest else ""
        raise ImportError(f"{getattr(found, '__file__', None) or module} has no {name}{hint}")
    return getattr(found, name)


def _folder_hint(error: BaseException, kind: str) -> str:
    """Return where the module of a class is searched, if it is the module that is missing, or its name without .py."""
    file, _, name = kind.partition(":")
    if file.endswith(".py"):
        return f"; write {file.removesuffix('.py')}:{name}"
    module = kind.partition(":")[0].partition(".")[0]
    is_absent = isinstance(error, ModuleNotFoundError) and error.name == module and module not in _OLD_PACKAGES
    return f"; start the command in the folder that has {module}, not in {Path.cwd()}" if is_absent else ""


class _OldPackages:
    """An import finder that rejects the old names of these packages, which a checkout would import a second time."""

    @staticmethod
    def find_spec(name: str, _path: object = None, _target: object = None) -> None:
        """Raise ModuleNotFoundError for an old name, unless a package of another project has it."""
        if name not in _OLD_PACKAGES:
            return
        found = PathFinder.find_spec(name)
        if found is None or found.origin is None or Path(found.origin).parent.resolve() == _HERE.parent / name:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


@contextmanager
def _old_packages_missing() -> Iterator[None]:
    sys.meta_path.insert(0, _OldPackages)
    try:
        yield
    finally:
        sys.meta_path.remove(_OldPackages)


def _why(error: BaseException, kind: str) -> str:
    """Return the cause of the error; for a module that moved, its new name."""
    if isinstance(error, ModuleNotFoundError) and error.name and _OLD_MODULE.fullmatch(error.name):
        named = next(filter(None, map(_OLD_MODULE.search, (*_lines(error.__traceback__), kind))), None)
        if named is not None:
            return f"{named[1]} is now sightline.{named[1]}; use that name"
    text = error_text(error)
    is_named = isinstance(error, ImportError | AttributeError | SightlineError)
    return (text if is_named else f"{type(error).__name__}: {text}")[:_LONGEST_DETAIL]


def _lines(trace: TracebackType | None) -> list[str]:
    """Return the source lines of a traceback, innermost first."""
    lines: list[str] = []
    while trace is not None:
        code = trace.tb_frame.f_code
        lines.insert(0, "" if code.co_filename == __file__ else linecache.getline(code.co_filename, trace.tb_lineno))
        trace = trace.tb_next
    return lines
