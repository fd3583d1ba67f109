"""What a detector may have besides `detect`, asked for through whatever is around it. Pure."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from sightline.protocol.errors import ConfigError, SightlineError
from sightline.protocol.transports.link import Link
from sightline.vision_side.detect.port import Detector, Maker

PLUGIN_ERRORS: Final = (Exception, SystemExit)
"""What a plug-in's own code may raise: `sys.exit` in it is to end itself, not the service around it."""
_LONGEST: Final = 160


class DetectorWrapper:
    """The base of combinators: one detector inside."""

    def __init__(self, inner: Detector) -> None:
        self.inner = inner

    def attach(self, link: Link) -> None:
        """Give the one inside a robot's link."""
        attach_detector(self.inner, link)

    def news(self) -> list[str]:
        """What the one inside has to say."""
        return notices_of(self.inner)

    @property
    def maker(self) -> Maker | None:
        """Who the one inside is, if it says."""
        return maker_of(self.inner)

    def close(self) -> None:
        """Close the one inside."""
        close_detector(self.inner)


def attach_detector(detector: Any, link: Link) -> None:
    """Give a detector that hears something else of a robot than frames its link, before the first frame."""
    attach: Callable[[Link], None] | None = getattr(detector, "attach", None)
    if attach is not None:
        with plugin_guard("the detector's attach()"):
            attach(link)


def notices_of(detector: Any) -> list[str]:
    """Lines for a person since the last time; none from a detector that has no `news`. One that raises is told of."""
    news: Callable[[], list[str]] | None = getattr(detector, "news", None)
    if news is None:
        return []
    try:
        return [" ".join(str(line).split()) for line in news()]
    except PLUGIN_ERRORS as error:  # who only talks badly may still see well
        return [_raises("the detector's news()", error)]


def maker_of(detector: Any) -> Maker | None:
    """Who makes its results, where that is known before the first of them."""
    maker: Maker | None = getattr(detector, "maker", None)
    return maker


def close_detector(detector: Any) -> None:
    """Let go of what a detector holds; nothing to do for one that has no `close`."""
    close: Callable[[], None] | None = getattr(detector, "close", None)
    if close is not None:
        with plugin_guard("the detector's close()"):
            close()


@contextmanager
def plugin_guard(what: str) -> Iterator[None]:
    """Whatever a plug-in's own code raises becomes a ConfigError that says whose fault it is."""
    try:
        yield
    except SightlineError:
        raise
    except PLUGIN_ERRORS as error:
        raise ConfigError(f"{_raises(what, error)}; it has to be mended") from error


def _raises(what: str, error: BaseException) -> str:
    return f"{what} raises {type(error).__name__}: {' '.join(str(error).split())}"[:_LONGEST]
