"""The configuration a service is started with: what was given, and what that implies. Shell."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from operator_side.settings import Given, Loaded, load


def load_service(
    service: str,
    *,
    environ: Mapping[str, str],
    profile: str | None = None,
    file: str | None = None,
    sets: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
) -> Loaded:
    """As `settings.load`, with the values implied by others filled in. Raises ConfigError as it does."""
    given: dict[str, Any] = {
        "profile": profile, "file": file, "sets": sets, "options": options, "environ": environ,
    }
    loaded = load(service, **given)
    implied = tuple(_implied(loaded))
    return load(service, **given, implied=implied) if implied else loaded


def _implied(loaded: Loaded) -> Iterator[Given]:
    """A robot told where to connect need not listen, nor a vision box told to listen connect; a simulated drive has a
    simulated range sensor, so that the guard is on wherever there are walls."""
    service, config = loaded.service, loaded.config
    listens, connects = (loaded.origin((name,)) != "default" for name in ("listen", "connect"))
    if service == "robot" and connects and not listens:
        yield Given(("listen",), (), "implied by connect")
    if service == "vision" and listens and not connects:
        yield Given(("connect",), (), "implied by listen")
    if service == "robot":
        yield from _implied_range_sensor(config.model_dump())


def _implied_range_sensor(robot: Mapping[str, Any]) -> Iterator[Given]:
    drive, sensor = robot["drive"], robot["range_sensor"]
    if drive["kind"] == "sim" and (sensor is None or sensor["kind"] == "sim"):
        origin = "implied by drive"
        yield Given(("range_sensor", "kind"), "sim", origin)
        for name, value in drive["options"].items():  # the same simulation
            yield Given(("range_sensor", "options", name), value, origin)
