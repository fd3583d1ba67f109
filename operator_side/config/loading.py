"""A service's configuration: defaults < profile < file < environment < --set < options. Shell (files).

    loaded = load("robot", file="robot.toml", sets=["safety.max_linear_mps=0.3"], environ=os.environ)
    loaded.config, loaded.origin("safety.max_linear_mps")

Environment names are SIGHTLINE_<SERVICE>__<KEY>, `__` for each dot: SIGHTLINE_ROBOT__SAFETY__MAX_LINEAR_MPS=0.3.
"""

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from sightline.operator_side.config.context import CONNECT_VARIABLE
from sightline.operator_side.config.errors import explain, is_known, known_keys, no_such_name, wrong_type
from sightline.operator_side.config.toml_text import key_and_text, parse_toml, toml_value
from sightline.protocol.config import Config, file_text
from sightline.protocol.errors import ConfigError, home_path
from sightline.protocol.log import LOG_FORMAT_VARIABLE
from sightline.protocol.transports.endpoints import check_endpoint, check_robot_id

SERVICES: Final = ("robot", "vision", "sim")
ENV_PREFIX: Final = "SIGHTLINE_"
OTHER_ENV_NAMES: Final = ("SIGHTLINE_DEBUG", LOG_FORMAT_VARIABLE, CONNECT_VARIABLE)
"""Names that services accept but do not read as configuration; CONNECT_VARIABLE is for client commands."""
PROFILES: Final = Path(__file__).parent / "profiles"

Key = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Given:
    """One given value. `text` is the original text of an option or variable; `origin` names the source."""

    key: Key
    value: Any
    origin: str
    text: str | None = None


@dataclass(frozen=True, slots=True)
class Loaded:
    """A validated configuration, and the origin of its values."""

    service: str
    config: Config
    given: Mapping[Key, Given]

    def origin(self, key: Key) -> str:
        """Return the origin of the value at `key`, or "default"."""
        given = given_at(self.given, key)
        return given.origin if given else "default"


def model_of(service: str) -> type[Config]:
    """Return the configuration model of a service. Raises ConfigError for an unknown service."""
    if service == "robot":
        from sightline.robot_side.config import RobotConfig

        return RobotConfig
    if service == "vision":
        from sightline.vision_side.config import VisionConfig

        return VisionConfig
    if service == "sim":
        from sightline.sim.process import SimConfig

        return SimConfig
    raise ConfigError(no_such_name("service", service, SERVICES))


def load(
    service: str,
    *,
    profile: str | None = None,
    file: str | None = None,
    sets: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
    environ: Mapping[str, str],
    implied: Sequence[Given] = (),
) -> Loaded:
    """Merge all sources and validate the result.

    Args:
        options: dotted keys and values; None means not given.
        implied: values that follow from others; every source overrides them.

    Raises:
        ConfigError: names the key, the value, its origin and the permitted values.
    """
    model = model_of(service)
    given: dict[Key, Given] = {}
    for one in (
        *implied,
        *_from_profile(service, profile),
        *(_from_file(file, file) if file is not None else ()),
        *_from_environment(service, environ),
        *(_from_set(text) for text in sets),
        *_from_options(options or {}),
    ):
        _put(given, one)
    _check_service(given, service, file)
    _check_names(given, service)
    return Loaded(service, _validated(model, given), given)


def given_at(given: Mapping[Key, Given], key: Key) -> Given | None:
    """Return the value given for `key`, or for the table or list that contains it."""
    for length in range(len(key), 0, -1):
        if key[:length] in given:
            return given[key[:length]]
    return None


# --- sources -----------------------------------------------------------------------------------------------------


def _from_profile(service: str, profile: str | None) -> Iterable[Given]:
    if profile is None:
        return ()
    names = [path.stem.removeprefix(f"{service}-") for path in sorted(PROFILES.glob(f"{service}-*.toml"))]
    if profile not in names:
        raise ConfigError(no_such_name("profile", profile, names))
    return _from_file(str(PROFILES / f"{service}-{profile}.toml"), f"profile {profile}")


def _from_file(file: str, origin: str) -> Iterable[Given]:
    if not file:
        raise ConfigError("the name of the configuration file is empty; name a TOML file, or leave out --config")
    try:
        return [Given(key, value, origin)
                for key, value in _leaves(parse_toml(file_text(file)))]
    except OSError as error:
        raise ConfigError(f"cannot read {file}: {error.strerror}; name a TOML file that you may read") from None
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{file}: invalid TOML: {error}{_fix_of(file, error)}") from None


def _fix_of(file: str, error: Exception) -> str:
    """Return the fix for a number with a decimal comma in the line of the error, or ""."""
    place = re.search(r"at line (\d+)", str(error))
    lines = home_path(file).read_text("utf-8").splitlines() if place else []
    found = re.search(r"=\s*(-?\d+),(\d+)\s*(#|$)", lines[int(place[1]) - 1]) if place and lines else None
    return f"; write {found[1]}.{found[2]} with a point" if found else ""


def _leaves(table: Mapping[str, Any], above: Key = ()) -> Iterable[tuple[Key, Any]]:
    for name, value in table.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*above, name))
        else:
            yield (*above, name), value


def _from_environment(service: str, environ: Mapping[str, str]) -> Iterable[Given]:
    for name in sorted(environ):
        if not name.startswith(ENV_PREFIX) or name in OTHER_ENV_NAMES:
            continue
        owner, *key = name.removeprefix(ENV_PREFIX).lower().split("__")
        if owner not in SERVICES or not key or not is_known(model_of(owner), tuple(key)):
            raise ConfigError(no_such_name("environment variable", name, _environment_names()))
        if owner == service:
            yield Given(tuple(key), toml_value(environ[name]), name, environ[name])


def _environment_names() -> list[str]:
    keys = [(service, *key) for service in SERVICES for key in known_keys(model_of(service))]
    return [*OTHER_ENV_NAMES, *(ENV_PREFIX + "__".join(key).upper() for key in keys)]


def _from_set(text: str) -> Given:
    name, value = key_and_text(text, "--set", "safety.max_linear_mps=0.3")
    return Given(tuple(name.split(".")), toml_value(value), "--set", value)


def _from_options(options: Mapping[str, Any]) -> Iterable[Given]:
    for key, value in options.items():
        if value is not None:
            table, _, name = key.rpartition(".")
            name = table if name == "kind" else name  # detector.kind is the option --detector
            yield Given(tuple(key.split(".")), value, f"--{name.replace('_', '-')}")


# --- merging and checking ----------------------------------------------------------------------------------------


def _put(given: dict[Key, Given], one: Given) -> None:
    """Store a value. It replaces older values at the same key, above it or below it."""
    key = one.key
    for other in [old for old in given if old[: len(key)] == key or key[: len(old)] == old]:
        del given[other]
    given[key] = one


def _check_service(given: Mapping[Key, Given], service: str, file: str | None) -> None:
    """Raise ConfigError for a file of another service."""
    names = {key[0] for key, one in given.items() if file and one.origin == file}
    for other in SERVICES:
        if not names <= model_of(service).model_fields.keys() and names <= model_of(other).model_fields.keys():
            raise ConfigError(f"{file} is a configuration of `sightline {other}`, not of `sightline {service}`")


def _check_names(given: Mapping[Key, Given], service: str) -> None:
    """Check robot id and endpoints here, for a clearer error than that of a pattern."""
    robot = given.get(("robot",)) if service != "sim" else None  # for sim it names the robot model
    robot_id = None if robot is None else robot.value if isinstance(robot.value, str) else robot.text
    if robot_id is not None:
        # A vision service may name several robots with `*` and `?`.
        plain_id = robot_id.replace("*", "x").replace("?", "x") if service == "vision" else robot_id
        with _labeled(given, ("robot",)):
            check_robot_id(plain_id)
    for key in (("listen",), ("connect",)):
        for endpoint in _as_list(given[key].value) if key in given else ():
            if isinstance(endpoint, str):
                with _labeled(given, key):
                    check_endpoint(endpoint)


@contextmanager
def _labeled(given: Mapping[Key, Given], key: Key) -> Iterator[None]:
    """Add the place of `key` to the ConfigError of its value."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{_label(given, key)}: {error}") from None


def _as_list(value: Any) -> list[Any]:
    if isinstance(value, str):
        return [part.strip() for part in value.split(",")]
    return list(value) if isinstance(value, list | tuple) else [value]


def _validated(model: type[Config], given: dict[Key, Given]) -> Config:
    for key, one in given.items():
        if one.text is None and (problem := wrong_type(model, key, one.value)):
            raise ConfigError(_label(given, key) + problem)
    try:
        return model.model_validate(_tree(model, given))
    except ValidationError as error:
        if _reread_typed_text(given, error):
            return _validated(model, given)
        text = explain(model, error, lambda key: _typed(given, key), lambda key: _label(given, key))
        raise ConfigError(text) from None


def _tree(model: type[Config], given: Mapping[Key, Given]) -> dict[str, Any]:
    """Merge the given values over the defaults, so that one key of a table does not change the others."""
    tree = model().model_dump()
    for key, one in given.items():
        table = tree
        for name in key[:-1]:
            if not isinstance(table.get(name), dict):
                table[name] = {}
            table = table[name]
        table[key[-1]] = one.value
    return tree


def _reread_typed_text(given: dict[Key, Given], error: ValidationError) -> bool:
    """Use a value as text if TOML parsed it as another type (`--set robot=1`, a single endpoint)."""
    changed = False
    for problem in error.errors(include_url=False, include_context=False):
        key = tuple(str(part) for part in problem["loc"])
        one = given.get(key)
        if one is None or one.text is None:
            continue
        if problem["type"] == "string_type" and one.value != one.text:
            given[key] = Given(key, one.text, one.origin, one.text)
            changed = True
        if problem["type"] == "tuple_type" and isinstance(one.value, str):
            given[key] = Given(key, tuple(_as_list(one.value)), one.origin, one.text)
            changed = True
    return changed


def _typed(given: Mapping[Key, Given], key: Key) -> Key:
    """Return the key as it was given, if the error names only its table."""
    return next((typed for typed in given if typed[: len(key)] == key), key)


def _label(given: Mapping[Key, Given], key: Key) -> str:
    """Name `key` and its source as written; for a missing key, name the file of its neighbors."""
    inside = (one for at, one in given.items() if at[: len(key)] == key)  # a table in place of a value
    one, dotted = given_at(given, key) or next(inside, None), ".".join(key)
    if one is None:
        beside = (one.origin for at, one in given.items() if len(key) > 1 and at[: len(key) - 1] == key[:-1])
        file = next((origin for origin in beside if not origin.startswith((ENV_PREFIX, "--"))), "")
        return f"{file}: {dotted}" if file else dotted
    if one.origin == "--set":
        return f"--set {dotted}"
    return one.origin if one.origin.startswith((ENV_PREFIX, "--")) else f"{one.origin}: {dotted}"


# --- the configuration of a service: the given values, and values that follow from them --------------------------


def load_service(
    service: str,
    *,
    environ: Mapping[str, str],
    profile: str | None = None,
    file: str | None = None,
    sets: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
) -> Loaded:
    """Load a configuration with the values that follow from others. Raises ConfigError as `load` does."""
    given: dict[str, Any] = {
        "profile": profile, "file": file, "sets": sets, "options": options, "environ": environ,
    }
    loaded = load(service, **given)
    implied = tuple(_implied(loaded))
    return load(service, **given, implied=implied) if implied else loaded


def _implied(loaded: Loaded) -> Iterator[Given]:
    """Yield implied values: a robot that connects need not listen; a vision service that listens need not connect."""
    service = loaded.service
    listens, connects = (loaded.origin((name,)) != "default" for name in ("listen", "connect"))
    if service == "robot" and connects and not listens:
        yield Given(("listen",), (), "implied by connect")
    if service == "vision" and listens and not connects:
        yield Given(("connect",), (), "implied by listen")
