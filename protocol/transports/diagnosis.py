"""Explains why an endpoint cannot be opened: which process holds the port, what is wrong with TLS. Shell."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path

from sightline.protocol.transports.endpoints import parse_zenoh_endpoint
from sightline.protocol.transports.security import RoleKeys

_LISTEN = "0A"


def port_owner(port: int) -> str:
    """`python3 (pid 4711)` for the process listening on TCP `port`; "" where that cannot be found out."""
    sockets = {f"socket:[{inode}]" for table in ("tcp", "tcp6") for inode in _listening_inodes(table, port)}
    for process in Path("/proc").glob("[0-9]*") if sockets else ():
        if any(_target(link) in sockets for link in _descriptors(process)):
            return f"{_name(process)} (pid {process.name})"
    return ""


def _listening_inodes(table: str, port: int) -> list[str]:
    try:
        rows = Path("/proc/net", table).read_text("ascii").splitlines()[1:]
    except OSError:
        return []
    fields = [row.split() for row in rows]
    return [row[9] for row in fields if row[3] == _LISTEN and int(row[1].rpartition(":")[2], 16) == port]


def _descriptors(process: Path) -> list[Path]:
    """The process's open files; none if it is gone or not ours to look at."""
    try:
        return list((process / "fd").iterdir())
    except OSError:
        return []


def _target(descriptor: Path) -> str:
    try:
        return str(descriptor.readlink())
    except OSError:  # closed meanwhile
        return ""


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text("utf-8", "replace").strip()
    except OSError:
        return "a process"


# Why a TLS link did not come about, in words: Zenoh says only that nobody answered. Shell (one connection).


_TLS_TIMEOUT_S = 1.0
_PLAIN = "it is a plain link, not TLS; give --secure there too, or on neither end"
_CAUSES = (
    ("certificate has expired", "its certificate has expired; make new keys there"),
    ("Hostname mismatch", "its certificate names other hosts; sightline keys add DIR ROLE --host HOST"),
    ("IP address mismatch", "its certificate names other addresses; sightline keys add DIR ROLE --host ADDRESS"),
    ("CERTIFICATE_VERIFY_FAILED", "its certificate is of another authority; use keys of one `sightline keys init`"),
    ("ALERT_UNKNOWN_CA", "it does not know our certificate's authority; use keys of one `sightline keys init`"),
    ("ALERT_CERTIFICATE_EXPIRED", "it finds our certificate expired; sightline keys add DIR ROLE"),
    ("ALERT_CERTIFICATE_REQUIRED", "it asks for a certificate; give --secure DIR"),
    ("ALERT_DECRYPT_ERROR", "it does not know our certificate's authority; use keys of one `sightline keys init`"),
    ("WRONG_VERSION_NUMBER", _PLAIN),
    ("RECORD_LAYER_FAILURE", _PLAIN),
)


def diagnose_tls(endpoint: str, secured: RoleKeys | None) -> str:
    """What is wrong between this end and `endpoint`; "" if TLS is not what is wrong."""
    transport, host, port = parse_zenoh_endpoint(endpoint)
    if transport == "quic" or (transport != "tls" and secured is None and not _speaks_tls(host, port)):
        return ""
    if transport != "tls":
        return "it speaks TLS only; write tls/... and give --secure DIR"
    if secured is None:
        return "a tls/ endpoint needs keys; give --secure DIR"
    context = ssl.create_default_context(cafile=f"{secured.folder}/ca.pem")
    context.load_cert_chain(f"{secured.folder}/{secured.role}.pem", f"{secured.folder}/{secured.role}.key")
    return _try_handshake(host, port, context)


def _speaks_tls(host: str, port: int) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with (
            socket.create_connection((host, port), _TLS_TIMEOUT_S) as plain,
            context.wrap_socket(plain, server_hostname=host),
        ):
            return True
    except OSError:
        return False


def _try_handshake(host: str, port: int, context: ssl.SSLContext) -> str:
    """Shake hands as Zenoh would, and wait a moment for the other end's verdict on our certificate."""
    try:
        with socket.create_connection((host, port), _TLS_TIMEOUT_S) as plain:
            try:
                secure = context.wrap_socket(plain, server_hostname=host)
            except TimeoutError:
                return _PLAIN
            with secure:
                secure.recv(1)
    except ssl.SSLError as error:
        return next((words for sign, words in _CAUSES if sign in str(error)), f"TLS: {error.reason}")
    except OSError:
        return ""
    return ""
