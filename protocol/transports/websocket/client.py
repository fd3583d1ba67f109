"""The connecting end: connects to one endpoint, and reconnects after a loss. Shell."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from sightline.protocol.log import report_fault
from sightline.protocol.transports.endpoints import SEND_BUFFER_BYTES, WebSocketEndpoint
from sightline.protocol.transports.security import bearer_header, certificate_role, own_token
from sightline.protocol.transports.websocket.connection import Connection
from sightline.protocol.transports.websocket.framing import MAX_HELLO_BYTES, SUBPROTOCOL, PeerError
from sightline.protocol.transports.websocket.peer import OPEN_S, PROTOCOL_OPTIONS
from sightline.protocol.transports.websocket.tls import client_tls_context, tls_handshake

if TYPE_CHECKING:
    from websockets.exceptions import ConnectionClosed
    from websockets.typing import Subprotocol

FIRST_PAUSE_S: Final = 0.2
LONGEST_PAUSE_S: Final = 1.0
PAUSE_GROWTH: Final = 1.5
# Advice by the verification code of OpenSSL.
_FIXES: Final = {
    9: "set the clock of this machine",  # X509_V_ERR_CERT_NOT_YET_VALID
    10: "make new keys, or set the clock of this machine",  # X509_V_ERR_CERT_HAS_EXPIRED
}


class Client:
    """Maintains one connection to `endpoint` until closed."""

    def __init__(
        self,
        endpoint: WebSocketEndpoint,
        serve: Callable[[Connection], None],
        count_rejection: Callable[[str], None],
        keys: tuple[str, str] = ("", ""),
        max_bytes: int = MAX_HELLO_BYTES,
    ) -> None:
        """Start to connect.

        Args:
            endpoint: the endpoint.
            serve: serves one connection until it is gone; it raises PeerError to drop the connection.
            count_rejection: counts a rejection by its reason.
            keys: folder with the token and the trusted authority of this end, and the role of the link.
            max_bytes: security limit for a message that comes with the answer to the handshake.

        Raises:
            ConfigError: a file of the folder is invalid.
        """
        self.endpoint = endpoint
        self._token = "" if endpoint.legacy else own_token(*keys)
        self._keys = keys
        self._context = client_tls_context(keys[0]) if endpoint.secure else None
        self._serve, self._count_rejection, self._max_bytes = serve, count_rejection, max_bytes
        self._closing = threading.Event()
        self.trouble = ""
        """Cause of the last failure, for the operator. Empty while no peer answers."""
        self.turned_away = threading.Event()
        """Set when a peer has answered and rejects this end permanently."""
        threading.Thread(target=self._run, name="websocket-dial", daemon=True).start()

    def close(self) -> None:
        """End the attempts to connect. The link closes an open connection."""
        self._closing.set()

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._closing.is_set():
            if self._connect():
                pause_s = FIRST_PAUSE_S
            # The first pause is short, because most losses are a restart of the robot. Later ones are longer, so that
            # many clients do not flood a robot that starts.
            self._closing.wait(pause_s)
            pause_s = min(LONGEST_PAUSE_S, pause_s * PAUSE_GROWTH)

    def _connect(self) -> bool:
        """Serve one connection from beginning to end. Returns False if it failed."""
        from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus

        try:
            self._speak(self._open())
            return True
        except InvalidStatus as error:
            answer = (error.response.body or b"").decode("utf-8", "replace").strip()
            status = error.response.status_code
            self._turned_away(self._missing_token(status) or answer[:200] or f"HTTP {status}", status < 500)
        except ConnectionClosed as error:
            self._turned_away(error.rcvd.reason if error.rcvd else "closed without a reason", _is_final(error))
        except PeerError as error:
            self._turned_away(str(error), True)
        except InvalidHandshake as error:
            if isinstance(error.__cause__, EOFError):
                self._turned_away(self._hangs_up(), False)
            else:
                self._turned_away(f"the service there is not a Sightline WebSocket ({type(error).__name__})", True)
        except (ssl.SSLEOFError, ssl.SSLZeroReturnError):
            self._turned_away(self._hangs_up(), False)
        except ssl.SSLError as error:
            why = getattr(error, "verify_message", "") or error.reason or type(error).__name__
            fix = _FIXES.get(getattr(error, "verify_code", 0), "use the ca.pem of its authority in --secure")
            self._turned_away(f"no TLS: {why}; {fix}", True)
        except OSError:  # no listener, or no answer in time
            self.trouble = ""
        # A broken peer can cause any error in the library. This thread must continue.
        except Exception as error:
            self._turned_away(f"{type(error).__name__}: {report_fault('websocket', error)}"[:200], False)
        return False

    def _missing_token(self, status: int) -> str:
        """Return the missing file of this end's folder, if a peer that requires a token answers with `status`."""
        folder, source = self._keys
        if status != 401 or not folder or self._token:
            return ""
        missing = f"{certificate_role(source)}.token is missing in {folder}"
        return f"{missing}; copy it from the folder of `sightline keys init` to this machine"

    def _hangs_up(self) -> str:
        """Return the likely causes of a connection that closes without a byte."""
        other = "ws://" if self.endpoint.secure else "wss://"
        return f"it closed without an answer: too many connections, or it expects {other}, or it is not Sightline"

    def _open(self) -> Connection:
        from websockets.client import ClientProtocol
        from websockets.uri import parse_uri

        end = self.endpoint
        near = socket.create_connection((end.host, end.port), OPEN_S)
        # A small buffer, because a newer message cannot replace data that the kernel already holds.
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        if self._context is not None:
            near = tls_handshake(near, self._context, end.host, time.monotonic() + OPEN_S)
        name = f"[{end.host}]" if ":" in end.host else end.host
        subprotocol: Subprotocol = SUBPROTOCOL  # type: ignore[assignment]
        protocol = ClientProtocol(
            parse_uri(f"{'wss' if end.secure else 'ws'}://{name}:{end.port}/"),
            subprotocols=None if end.legacy else [subprotocol],
            max_size=self._max_bytes,
            **PROTOCOL_OPTIONS,
        )
        request = protocol.connect()
        # In a header, not in the address, because proxies and servers log addresses.
        if self._token:
            request.headers["Authorization"] = bearer_header(self._token)
        protocol.send_request(request)
        return Connection(near, protocol)

    def _speak(self, wire: Connection) -> None:
        """Run the handshake, and serve until the connection ends."""
        try:
            wire.flush()
            wire.receive_one(time.monotonic() + OPEN_S)
            if wire.protocol.handshake_exc is not None:
                raise wire.protocol.handshake_exc
            if not self.endpoint.legacy and wire.protocol.subprotocol != SUBPROTOCOL:
                raise PeerError("WRONG_SUBPROTOCOL", 1002, f"the service there does not support {SUBPROTOCOL}")
            self._serve(wire)
        except PeerError as error:
            self._count_rejection(error.counted)
            wire.close(error.code, str(error))
            # Without this wait, a reset of the connection could overtake the reason.
            wire.linger()
            raise
        finally:
            wire.shut()

    def _turned_away(self, why: str, final: bool) -> None:
        self.trouble = why
        if final:
            self.turned_away.set()


def _is_final(closed: ConnectionClosed) -> bool:
    """Return True if another attempt is useless."""
    # 1000 and 1001: the peer ends or restarts. 1013: it has no free place now. These can change.
    return closed.rcvd is not None and closed.rcvd.code not in (1000, 1001, 1013)
