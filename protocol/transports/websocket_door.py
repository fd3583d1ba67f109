"""The socket that a WebSocket endpoint listens on, and why there is none. Shell (sockets)."""

import errno
import os
import socket

from sightline.protocol.errors import LinkError
from sightline.protocol.transports.endpoints import SEND_BUFFER_BYTES
from sightline.protocol.transports.diagnosis import port_owner
from sightline.protocol.transports.websocket_endpoints import WebSocketEndpoint


def listening_socket(endpoint: WebSocketEndpoint) -> socket.socket:
    """Listen at `endpoint`. Raises LinkError, with the cause and the way out, if that is not possible."""
    family = socket.AF_INET6 if ":" in endpoint.host else socket.AF_INET
    try:
        listening = socket.create_server((endpoint.host, endpoint.port), family=family)
    except OSError as error:
        raise _cannot_listen(endpoint, error) from None
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)  # accepted sockets inherit it
    return listening


def _cannot_listen(endpoint: WebSocketEndpoint, error: OSError) -> LinkError:
    if error.errno == errno.EADDRINUSE:
        owner = port_owner(endpoint.port) or "another process"
        fix = f"port {endpoint.port} is in use by {owner}; end it or choose another port"
        return LinkError(f"cannot listen on {endpoint.text}: {fix}")
    # create_server adds to strerror what it attempted; a name that is not known has an errno of its own below zero.
    cause = os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror
    return LinkError(
        f"cannot listen on {endpoint.text}: {cause}; use an address of this machine, e.g. ws://127.0.0.1:{endpoint.port}"
    )
