"""TLS for `wss://`, with certificates from a `--secure` folder. Shell (files, sockets).

    <role>.pem <role>.key  what this end shows when it listens, e.g. robot.pem
    ca.pem                 whose signature this end trusts when it connects

A file of its own, since `ssl` takes 4 MB that a robot without `wss://` need not have.
"""

import select
import socket
import ssl
import time
from pathlib import Path

from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.security import certificate_role


def server_tls_context(folder: str, source: str) -> ssl.SSLContext:
    """TLS for who listens. Raises ConfigError for a certificate or key that is missing or does not fit."""
    role = certificate_role(source)
    certificate, key = (Path(folder).expanduser() / f"{role}.{kind}" for kind in ("pem", "key"))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key)
    except FileNotFoundError:
        raise ConfigError(f"wss:// needs {role}.pem and {role}.key in a folder: give it with --secure DIR") from None
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"{certificate} and {key} are no certificate and its key: {error}") from None
    return context


def client_tls_context(folder: str) -> ssl.SSLContext:
    """TLS for who connects: trusts the folder's `ca.pem`, or without a folder what this machine trusts."""
    authority = Path(folder).expanduser() / "ca.pem"
    try:
        return ssl.create_default_context(cafile=str(authority) if folder else None)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"{authority} holds no certificate of an authority: {error}") from None


def tls_handshake(near: socket.socket, context: ssl.SSLContext, host: str, deadline_s: float) -> ssl.SSLSocket:
    """`near` with TLS agreed on; `host` is whom this end connects to, "" for who listens.

    Raises TimeoutError at `deadline_s` however slowly the other end goes on, and SSLError for one that does not agree.
    """
    near.setblocking(False)
    wrapped = context.wrap_socket(
        near, server_side=not host, server_hostname=host or None, do_handshake_on_connect=False
    )
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
