"""Convert TOML text and names to frozen models, with a fix in each error. Pure (reads files, stores no state)."""

import difflib
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sightline.protocol.config import file_text
from sightline.protocol.errors import ConfigError

Model = TypeVar("Model", bound=BaseModel)


def find(kind: str, name: str, folder: Path) -> Path:
    """Return the file of `name`: a path if it ends in `.toml`, otherwise a file of `folder`.

    Raises ConfigError with the nearest name and all names for an unknown one.
    """
    path = Path(name) if name.endswith(".toml") else folder / f"{name}.toml"
    if is_file(path) and (name.endswith(".toml") or name in names_in(folder)):
        return path
    if name.endswith(".toml"):
        raise ConfigError(f"no {kind} file {name}; by name there are {', '.join(names_in(folder))}")
    raise ConfigError(f"no {kind} called {name!r}{_nearest(name, folder)}; there are {', '.join(names_in(folder))}")


def is_file(path: Path) -> bool:
    """Return True if the file exists; False for an invalid name, e.g. a very long one."""
    try:
        return path.is_file()
    except OSError:
        return False


def names_in(folder: Path) -> list[str]:
    """Return the names of the files of `folder`, sorted."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def _nearest(name: str, folder: Path) -> str:
    near = difflib.get_close_matches(name, names_in(folder), n=1, cutoff=0.4)
    return f", did you mean {near[0]!r}?" if near else ""


def read_table(path: Path, folder: Path | None = None) -> dict[str, Any]:
    """Read a file as a table, merged over the file of `folder` that it `extends`, if any.

    Raises ConfigError with the file and the line of invalid TOML.
    """
    try:
        table = tomllib.loads(file_text(path))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}; name a TOML file that you may read") from None
    except (ValueError, RecursionError) as error:  # also a number with too many digits
        raise ConfigError(f"{path}: cannot be read as TOML: {error}") from None
    return _extended(table, path, folder) if folder and "extends" in table else table


def _extended(table: dict[str, Any], path: Path, folder: Path) -> dict[str, Any]:
    """Merge the extended table. Only a file of Sightline that extends no other file can be extended."""
    name = str(table.pop("extends"))
    if name not in names_in(folder) or name == path.stem:
        raise ConfigError(f"{path}: extends: nothing is called {name!r}{_nearest(name, folder)}")
    under = read_table(folder / f"{name}.toml")
    if "extends" in under:
        raise ConfigError(f"{path}: extends {name!r}, which extends another; extend {under['extends']!r} itself")
    return laid_over(under, table)


def laid_over(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Merge `over` into `under`: tables of one kind are merged, other values replaced, and `{}` removes a table."""
    merged = dict(under)
    for name, value in over.items():
        merged[name] = laid_over(under[name], value) if _is_more_of(under.get(name), value) else value
    return merged


def _is_more_of(under: Any, over: Any) -> bool:
    """Return True if a table extends another one. With another `kind` it replaces it."""
    both = isinstance(under, dict) and isinstance(over, dict) and bool(over)
    return both and over.get("kind", under.get("kind")) == under.get("kind")


def check(model: type[Model], table: dict[str, Any], path: Path) -> Model:
    """Return `table` as a `model`. Raises ConfigError with the file, the first invalid key and its error."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        raise ConfigError(f"{path}: {_first_problem(model, error)}") from None


def _first_problem(model: type[BaseModel], error: ValidationError) -> str:
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(str(part) for part in first["loc"]) or "file"
    if first["type"] == "missing":
        return f"{where}: is missing"
    if first["type"] == "value_error":
        return f"{where}: {first['msg'].removeprefix('Value error, ')}{_got(first['input'])}"
    if first["type"] != "extra_forbidden":
        return f"{where}: {first['msg']} (got {str(first['input'])[:60]})"
    near = difflib.get_close_matches(str(first["loc"][-1]), _fields(model), n=1)
    return f"{where}: unknown key{f', did you mean {near[0]!r}?' if near else ''}"


def _got(value: Any) -> str:
    """Return a short value; a whole table would hide the problem."""
    return "" if isinstance(value, dict) else f" (got {str(value)[:60]})"


def _fields(model: type[BaseModel]) -> set[str]:
    """Return every field name reachable from `model`, for suggestions."""
    definitions = model.model_json_schema()
    tables = [definitions, *definitions.get("$defs", {}).values()]
    return {name for table in tables for name in table.get("properties", {})}
