"""Puts anything under any key, past every bound of a well-behaved link, as a stranger on Zenoh could. Shell (Zenoh)."""

from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Final, Self

from sightline.protocol.transports.security import load_role_keys
from sightline.protocol.transports.zenoh_session import open_session

_OPEN_S: Final = 5.0


class RawZenoh:
    """A session of its own at `endpoint`, opened when it is first needed; use it in a `with`."""

    def __init__(self, endpoint: str, folder: str = "", source: str = "vision") -> None:
        """`folder` holds the keys to come in with, those of `source`."""
        self._endpoint, self._folder, self._source = endpoint, folder, source
        self._put: Callable[..., None] | None = None
        self._ending = ExitStack()

    def put(self, key: str, header: bytes, payload: bytes) -> None:
        """Send it. Raises LinkError where nobody answers."""
        if self._put is None:
            secured = load_role_keys(self._folder, self._source)
            session = open_session((), [self._endpoint], _OPEN_S, secured)
            self._ending.callback(session.close)
            self._put = session.put
        self._put(key, payload, attachment=header or None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.close()
