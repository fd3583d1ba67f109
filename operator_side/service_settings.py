"""The configuration a service is started with: what was given, and what that implies. Shell."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sightline.operator_side.config.loading import Given, Loaded, load


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
    """A robot told where to connect need not listen, nor a vision box told to listen connect."""
    service = loaded.service
    listens, connects = (loaded.origin((name,)) != "default" for name in ("listen", "connect"))
    if service == "robot" and connects and not listens:
        yield Given(("listen",), (), "implied by connect")
    if service == "vision" and listens and not connects:
        yield Given(("connect",), (), "implied by listen")

