"""A thread for each connection, while there is a place: what serves beside a robot stays small. Shell (threads)."""

import threading
from socketserver import ThreadingMixIn
from typing import Any, Final

MAX_CONNECTIONS: Final = 32
"""Security limit: one more is closed at once. A browser holds six."""


class BoundedThreads(ThreadingMixIn):
    """For a socket server. A connection that says nothing holds up neither the others nor the end."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, *arguments: Any) -> None:
        self._places = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        """On a thread of its own, while there is a place."""
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)  # type: ignore[attr-defined]

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Give the place back afterwards."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()
