"""TLS for `wss://`, with certificates from a `--secure` folder. Shell (files, sockets).

    <role>.pem <role>.key  certificate of a listening end, e.g. robot.pem
    ca.pem                 authority that a connecting end trusts

This is a separate file, because `ssl` takes 4 MB that a robot without `wss://` does not need.
"""

import select
import socket
import ssl
import time

from sightline.protocol.errors import ConfigError, home_path
from sightline.protocol.transports.security import certificate_role


def server_tls_context(folder: str, source: str) -> ssl.SSLContext:
    """Create the TLS context of a listening end. Raises ConfigError for a missing or invalid certificate or key."""
    role = certificate_role(source)
    certificate, key = (home_path(folder) / f"{role}.{kind}" for kind in ("pem", "key"))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key)
    except FileNotFoundError:
        raise ConfigError(f"wss:// needs {role}.pem and {role}.key in a folder; pass --secure DIR") from None
    except PermissionError:
        raise ConfigError(f"this account may not read {role}.pem and {role}.key in {folder}") from None
    except OSError:  # also ssl.SSLError
        named = f"{role}.pem or {role}.key is damaged, or they do not belong together in {folder}"
        raise ConfigError(f"{named}; copy the files of {role} again from where they were made") from None
    return context


def client_tls_context(folder: str) -> ssl.SSLContext:
    """Create the TLS context of a connecting end. It trusts `ca.pem`, or without a folder the system's authorities."""
    try:
        return ssl.create_default_context(cafile=str(home_path(folder) / "ca.pem") if folder else None)
    except FileNotFoundError:
        raise ConfigError(f"ca.pem is missing in {folder}; copy it from the folder of `sightline keys init`") from None
    except PermissionError:
        raise ConfigError(f"this account may not read ca.pem in {folder}") from None
    except OSError:  # also ssl.SSLError
        raise ConfigError(f"ca.pem is damaged in {folder}; copy it again from where it was made") from None


def tls_handshake(near: socket.socket, context: ssl.SSLContext, host: str, deadline_s: float) -> ssl.SSLSocket:
    """Run the TLS handshake.

    Args:
        near: a connected socket.
        context: context of this end.
        host: server name, or "" at a listening end.
        deadline_s: end of the handshake on the monotonic clock, even for a slow peer.

    Raises:
        TimeoutError: at `deadline_s`.
        SSLError: the handshake failed.
    """
    near.setblocking(False)
    wrapped = context.wrap_socket(
        near, server_side=not host, server_hostname=host or None, do_handshake_on_connect=False
    )
    # BaseException, because the socket must not stay open after Ctrl-C either: the peer would wait for it.
    try:
        _finish_handshake(wrapped, deadline_s)
    except BaseException:
        wrapped.close()
        raise
    return wrapped


def _finish_handshake(wrapped: ssl.SSLSocket, deadline_s: float) -> None:
    waiting = select.poll()
    while (left_s := deadline_s - time.monotonic()) > 0:
        try:
            wrapped.do_handshake()
            return
        except ssl.SSLWantReadError:
            waiting.register(wrapped, select.POLLIN)
        except ssl.SSLWantWriteError:
            waiting.register(wrapped, select.POLLOUT)
        waiting.poll(left_s * 1000)
    raise TimeoutError
