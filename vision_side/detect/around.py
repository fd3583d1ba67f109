"""What a detector may have besides `detect`, asked for through whatever is around it. Pure."""

from collections.abc import Callable
from typing import Any

from protocol.transports.link import Link
from vision_side.detect.port import Detector, Maker


class Around:
    """The base of combinators: one detector inside."""

    def __init__(self, inner: Detector) -> None:
        self.inner = inner

    def attach(self, link: Link) -> None:
        """Give the one inside a robot's link."""
        attach_detector(self.inner, link)

    def news(self) -> list[str]:
        """What the one inside has to say."""
        return news_of(self.inner)

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
        attach(link)


def news_of(detector: Any) -> list[str]:
    """Lines for a person since the last time; none from a detector that has no `news`."""
    news: Callable[[], list[str]] | None = getattr(detector, "news", None)
    return [" ".join(str(line).split()) for line in news()] if news is not None else []


def maker_of(detector: Any) -> Maker | None:
    """Who makes its results, where that is known before the first of them."""
    maker: Maker | None = getattr(detector, "maker", None)
    return maker


def close_detector(detector: Any) -> None:
    """Let go of what a detector holds; nothing to do for one that has no `close`."""
    close: Callable[[], None] | None = getattr(detector, "close", None)
    if close is not None:
        close()
