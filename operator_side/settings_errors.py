"""What is wrong with a configuration, as one line a person can act on. Pure."""

import difflib
from collections.abc import Callable, Iterable
from typing import Any

from pydantic import BaseModel, ValidationError

from sightline.operator_side.config.errors import Key, allowed, known_keys

_LONGEST_VALUE = 60
_MOST_NAMES = 12


def no_such_name(kind: str, name: str, names: Iterable[str]) -> str:
    """`name` is none of `names`: say so, with the nearest, or those there are, the first if they are many."""
    names = list(names)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    shown = [*names[:_MOST_NAMES], *([f"and {len(names) - _MOST_NAMES} more"] if len(names) > _MOST_NAMES else [])]
    there_are = f"; there are: {', '.join(shown)}"
    return f"no {kind} called {name!r}" + (f"; did you mean {nearest[0]!r}?" if nearest else there_are)


def explain(
    model: type[BaseModel], error: ValidationError, typed: Callable[[Key], Key], label: Callable[[Key], str]
) -> str:
    """The first problem in full, and how many more there are.

    `typed` completes an unknown key to what was given below it; `label` names a key as its giver wrote it.
    """
    problems = error.errors(include_url=False)
    first = problems[0]
    key = tuple(str(part) for part in first["loc"])
    key = typed(key) if first["type"] == "extra_forbidden" else key
    text = f"{label(key)}{_problem(model, key, first)}"
    return text if len(problems) == 1 else f"{text} (and {len(problems) - 1} more)"


def _problem(model: type[BaseModel], key: Key, problem: Any) -> str:
    if problem["type"] == "extra_forbidden":
        return f": unknown key{_nearest_key(model, key)}"
    if problem["type"] == "missing":
        return ": is missing"
    if problem["type"] == "value_error":
        return f": {problem['ctx']['error']}"
    may_be = allowed(model, key)
    message = problem["msg"].replace("Input should be", "should be", 1)
    return f" = {_shown(problem['input'])}: {message}" + (f"; allowed: {may_be}" if may_be else "")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."


def _nearest_key(model: type[BaseModel], key: Key) -> str:
    in_list = any(part.isdigit() for part in key)
    names = _list_keys(model) if in_list else [".".join(known) for known in known_keys(model)]
    nearest = difflib.get_close_matches(key[-1] if in_list else ".".join(key), names, n=1, cutoff=0.6)
    return f"; did you mean {nearest[0]!r}?" if nearest else "; `sightline config show SERVICE` lists them"


def _list_keys(model: type[BaseModel]) -> list[str]:
    """Keys of all tables, for those that stand in a list."""
    return [name for table in model.model_json_schema().get("$defs", {}).values() for name in table["properties"]]
