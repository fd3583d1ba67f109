"""Many robots over one Zenoh session: who is there, and a `Link` to each. Shell.

    with open_site("r*", connect=["tcp/127.0.0.1:7447"], role="vision") as site:
        link = site.link("r1")
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from fnmatch import fnmatchcase
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from sightline.protocol.channels import FRAME, KEY_PREFIX, STATUS, parse_key
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.endpoints import check_zenoh_endpoints
from sightline.protocol.transports.link import Link
from sightline.protocol.transports.link_rules import LinkRules
from sightline.protocol.transports.security import load_role_keys
from sightline.protocol.transports.zenoh.link import ZenohLink
from sightline.protocol.transports.zenoh_presence import PresenceAnnouncer
from sightline.protocol.transports.zenoh_session import CLOSED_SESSION, open_session

if TYPE_CHECKING:
    import zenoh

MAX_ROBOTS: Final = 256
"""Security limit: no more robots than this, whatever a network claims."""


def open_fleet(
    pattern: str,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    role: str = "",
    timeout_s: float = 5.0,
    max_frame_bytes: int = FRAME.max_payload_bytes,
    secure: str = "",
    about: Callable[[], str] | None = None,
) -> ZenohFleet:
    """Open a session for every robot whose id fits `pattern` (`*` any text, `?` any letter); use it in a `with`.

    `about` gives the line that who asks who is there is told of this end, besides its role.
    Raises ConfigError for an endpoint or pattern that is none or not of Zenoh, LinkError as `open_zenoh` does.
    """
    for endpoint in (*listen, *connect):
        if "://" in endpoint:
            raise ConfigError(f"{endpoint}: several robots (--robot {pattern!r}) need Zenoh; write tcp/<host>:<port>")
    check_zenoh_endpoints(listen, connect)
    here = PresenceAnnouncer(role, pattern, secrets.token_hex(4), about) if role else None
    session = open_session(listen, connect, timeout_s, load_role_keys(secure, role))
    site = ZenohFleet(session, pattern, role, max_frame_bytes)
    if here is not None:
        site.announce(here)
    return site


class ZenohFleet:
    """One session. Robots are noticed by their status; a link to one shares the session."""

    def __init__(self, session: zenoh.Session, pattern: str, role: str, max_frame_bytes: int) -> None:
        """Take over an open `session`."""
        self._session, self._pattern, self._role, self._max_frame_bytes = session, pattern, role, max_frame_bytes
        self._ending = ExitStack()
        self._ending.callback(session.close)
        self._seen: dict[str, None] = {}
        self._news: Callable[[], None] = lambda: None
        self._listen()

    def announce(self, here: PresenceAnnouncer) -> None:
        """Answer whoever asks who is there."""
        self._ending.callback(here.answer_in(self._session))

    def robots(self) -> list[str]:
        """Ids of all that were heard so far, in the order of their first word."""
        return list(self._seen)

    def on_news(self, callback: Callable[[], None]) -> None:
        """Call `callback`, on Zenoh's thread, when a robot is heard for the first time."""
        self._news = callback

    def link(self, robot: str) -> Link:
        """A link to `robot` over the shared session, closed with the site."""
        rules = LinkRules(robot, self._role, self._max_frame_bytes)
        return self._ending.enter_context(ZenohLink(self._session, rules, shared=True))

    def close(self) -> None:
        """Close all links and the session."""
        self._ending.close()
        self._session = CLOSED_SESSION

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _listen(self) -> None:
        import zenoh

        handler = zenoh.handlers.Callback(self._note, indirect=False)
        subscriber = self._session.declare_subscriber(f"{KEY_PREFIX}/*/{STATUS.name}", handler)
        self._ending.callback(subscriber.undeclare)

    def _note(self, sample: zenoh.Sample) -> None:
        parsed = parse_key(str(sample.key_expr))
        if parsed is None or parsed[0] in self._seen or len(self._seen) >= MAX_ROBOTS:
            return
        if fnmatchcase(parsed[0], self._pattern):
            self._seen[parsed[0]] = None
            self._news()
