"""Find the process that uses a TCP port, and the cause of a failed TLS link. Shell."""

from __future__ import annotations

import datetime
import errno
import ipaddress
import os
import socket
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sightline.protocol.errors import LinkError
from sightline.protocol.transports.endpoints import OVER_UDP, parse_websocket_endpoint, parse_zenoh_endpoint
from sightline.protocol.transports.security import RoleKeys, date_problem

if TYPE_CHECKING:
    import ssl  # takes 4 MB, so functions import it only after an error

# Linux's lists of TCP sockets.
TABLES: Final = Path("/proc/net")
TCP_IPV4: Final = ("tcp",)
_TCP: Final = (*TCP_IPV4, "tcp6")
_LISTEN: Final = "0A"


def port_owner(port: int) -> str:
    """Find the process that listens on a TCP port.

    Args:
        port: local port.

    Returns:
        Name and number, e.g. `python3 (pid 4711)`, or "" if the system does not show it.
    """
    sockets = {f"socket:[{row[9]}]" for row in _rows({port}) if row[3] == _LISTEN}
    return process_with_open(sockets) if sockets else ""


def port_in_use(endpoint: str, port: int) -> LinkError:
    """Return the error of an endpoint whose port is in use by another process."""
    owner = port_owner(port) or "another process"
    return LinkError(f"cannot listen on {endpoint}: port {port} is in use by {owner}; end it or choose another port")


def check_ports(endpoints: Iterable[str]) -> None:
    """Raise LinkError if another process uses the TCP port of an endpoint. Other errors appear when it is opened."""
    for endpoint in endpoints:
        is_websocket = "://" in endpoint
        if is_websocket:
            _, host, port, *_ = parse_websocket_endpoint(endpoint)
        else:
            transport, host, port = parse_zenoh_endpoint(endpoint)
            if transport in OVER_UDP or "iface=" in endpoint:  # two interfaces may use one port
                continue
        try:
            address = ipaddress.ip_address(host)  # names are skipped, because they may take seconds
            with socket.socket(socket.AF_INET6 if address.version == 6 else socket.AF_INET) as tried:
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if address.version == 6 and is_websocket:
                    tried.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                tried.bind((host, port))
        except (OSError, ValueError) as error:
            if getattr(error, "errno", None) == errno.EADDRINUSE:
                raise port_in_use(endpoint, port) from None


def process_with_open(files: Collection[str], besides: int = 0) -> str:
    """Find a process that has one of the files open.

    Args:
        files: targets of the links in `/proc/PID/fd`.
        besides: number of a process to skip.

    Returns:
        Name and number, e.g. `python3 (pid 4711)`, or "" without such a process.
    """
    for process in Path("/proc").glob("[0-9]*"):
        if process.name != str(besides) and any(_target(link) in files for link in _descriptors(process)):
            return f"{_name(process)} (pid {process.name})"
    return ""


def unresolved_host(hosts: Iterable[str]) -> str:
    """Return the first of `hosts` without an address, or "" if all have one. A name server may take seconds."""
    for host in hosts:
        try:
            socket.getaddrinfo(host, None)
        # UnicodeError: Python cannot encode a label of more than 63 characters.
        except (socket.gaierror, UnicodeError):
            return host
    return ""


OWN_HOST: Final = "127.0.0.1"


def connection_ends(ports: Collection[int], tables: Sequence[str] = _TCP) -> dict[tuple[str, str], str]:
    """List the TCP connections to `ports` of this machine, including those that are closing.

    Args:
        ports: local ports.
        tables: `TCP_IPV4` if only IPv4 sockets listen on them. Reading a table takes several ms, even if it is empty.

    Returns:
        Both ends of each connection, as in the table, and its remote host: `OWN_HOST` for any address of this
        machine.
    """
    # The kernel writes the table in pieces, so a row can come twice while other sockets open and close.
    return {(row[1], row[2]): _remote_host(row) for row in _rows(ports, tables) if row[3] != _LISTEN}


_OPENED: Final = {"snmp": "PassiveOpens", "netstat": "TCPDeferAcceptDrop"}
"""Counters of connections that were opened to this machine, and of connections that it holds back until their first
byte."""


def opened_connections() -> int | None:
    """Return the number of connections opened to this machine so far, or None if the system does not show it.

    Use only changes of the count, because a connection that is held back counts twice. Reading it takes a thirtieth of
    the time of the socket table.
    """
    total = 0
    with suppress(OSError, ValueError, KeyError):
        for name, counter in _OPENED.items():
            rows = [line.split() for line in (TABLES / name).read_text("ascii").splitlines()]
            (names, values) = (row for row in rows if row[0] in ("Tcp:", "TcpExt:"))
            total += int(dict(zip(names, values, strict=True))[counter])
        return total
    return None


def own_sockets(wanted: Callable[[str], bool] = lambda name: name.startswith("socket:")) -> Iterator[socket.socket]:
    """Yield the sockets of this process, also those of libraries. Use each one before the next.

    Args:
        wanted: returns True for the target of an entry in `/proc/self/fd`. The default selects all sockets.
    """
    try:
        links = list(Path("/proc/self/fd").iterdir())
    except OSError:  # not on Linux
        return
    for link in links:
        with suppress(OSError):  # closed in the meantime
            if wanted(str(link.readlink())):
                number = os.dup(int(link.name))
                try:
                    one = socket.socket(fileno=number)
                except OSError:  # not a socket any longer
                    os.close(number)
                    continue
                with one:
                    yield one


def listening_inodes(ports: Collection[int]) -> set[str]:
    """Return the inodes of the sockets that listen on `ports`."""
    return {row[9] for row in _rows(ports) if row[3] == _LISTEN}


def _rows(ports: Collection[int], tables: Sequence[str] = _TCP) -> Iterator[list[str]]:
    """Yield the rows of the tables whose local port is one of `ports`, without storing the other rows."""
    endings = tuple(f":{port:04X}" for port in ports)
    for name in tables:
        with suppress(OSError), (TABLES / name).open(encoding="ascii") as table:  # not on Linux, or no IPv6
            for line in table:
                if line.split(None, 2)[1].endswith(endings):
                    yield line.split()


def _remote_host(row: Sequence[str]) -> str:
    local, remote = _host(row[1]), _host(row[2])
    return OWN_HOST if remote == local else remote


def _host(address: str) -> str:
    """Convert an address of the table to text."""
    # Each 32 bits are hex digits in the byte order of the machine.
    digits = address.rpartition(":")[0]
    words = [bytes.fromhex(digits[start:start + 8])[::-1] for start in range(0, len(digits), 8)]
    host = ipaddress.ip_address(b"".join(words))
    return str(getattr(host, "ipv4_mapped", None) or host)


def _descriptors(process: Path) -> list[Path]:
    """Return the open files of a process, or [] if it is gone or belongs to another user."""
    try:
        return list((process / "fd").iterdir())
    except OSError:
        return []


def _target(descriptor: Path) -> str:
    try:
        return str(descriptor.readlink())
    except OSError:  # closed in the meantime
        return ""


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text("utf-8", "replace").strip()
    except OSError:
        return "a process"


# The cause of a failed TLS link. Zenoh reports only that no peer answered. Shell (one connection).


_TLS_TIMEOUT_S = 1.0
_PLAIN = "it is a plain link, not TLS; pass --secure there too, or on neither end"
_SILENT = ("it does not answer TLS; it is a plain link (pass --secure there too, or on neither end), or others flood "
           "it (see its log)")
_EXPIRED = "its certificate has expired; make new keys there, or set the clock of this machine"
_NOT_YET = "its certificate is not valid yet; set the clock of this machine"
# Zenoh sends the same alert for both.
_CLOCK_THERE = ("the certificate of this end is valid here, but expired or not valid yet on the clock there; set the "
                "clock there")
_OF_CLOCKS = (_EXPIRED, _NOT_YET, _CLOCK_THERE)
_CAUSES = (
    ("certificate has expired", _EXPIRED),
    ("certificate is not yet valid", _NOT_YET),
    ("Hostname mismatch", "its certificate names other hosts; sightline keys add DIR ROLE --host HOST"),
    ("IP address mismatch", "its certificate names other addresses; sightline keys add DIR ROLE --host ADDRESS"),
    ("CERTIFICATE_VERIFY_FAILED", "its certificate is of another authority; use keys of one `sightline keys init`"),
    ("ALERT_UNKNOWN_CA", "it does not know the authority of this certificate; use keys of one `sightline keys init`"),
    ("ALERT_CERTIFICATE_EXPIRED", _CLOCK_THERE),
    ("ALERT_CERTIFICATE_REQUIRED", "it requires a certificate; pass --secure DIR"),
    ("ALERT_DECRYPT_ERROR", "it does not know our certificate's authority; use keys of one `sightline keys init`"),
    ("WRONG_VERSION_NUMBER", _PLAIN),
    ("RECORD_LAYER_FAILURE", _PLAIN),
)


def diagnose_tls(endpoint: str, secured: RoleKeys | None) -> str:
    """Return the cause of a failed TLS link to `endpoint`, or "" if TLS is not the cause."""
    transport, host, port = parse_zenoh_endpoint(endpoint)
    if transport == "quic" or (transport != "tls" and secured is None and not _speaks_tls(host, port)):
        return ""
    if transport != "tls":
        return "it accepts only TLS; use tls/... and pass --secure DIR"
    if secured is None:
        return "a tls/ endpoint needs keys; pass --secure DIR"
    try:
        cause = _try_handshake(host, port, _tls_context(secured))
    except LinkError as error:
        return str(error)
    if cause not in _OF_CLOCKS:
        return cause
    # First the own files, because a wrong clock here makes the files of both ends look invalid.
    return (date_problem(secured.folder, secured.role, datetime.timedelta(0))
            or f"{cause} (here it is {datetime.datetime.now(datetime.UTC):%Y-%m-%d %H:%M} UTC)")


def keys_problem(secured: RoleKeys) -> str:
    """Return the error in the files of this end, or "" if they are readable and belong together."""
    try:
        _tls_context(secured)
    except LinkError as error:
        return str(error)
    return ""


def _tls_context(secured: RoleKeys) -> ssl.SSLContext:
    """Load the files of this end. Raises LinkError."""
    import ssl

    role, folder = secured.role, secured.folder
    try:
        named = "ca.pem is damaged"
        context = ssl.create_default_context(cafile=f"{folder}/ca.pem")
        named = f"{role}.pem or {role}.key is damaged, or they do not belong together"
        context.load_cert_chain(f"{folder}/{role}.pem", f"{folder}/{role}.key")
    except PermissionError:
        raise LinkError(f"this account may not read ca.pem, {role}.pem and {role}.key in {folder}") from None
    except OSError:  # also ssl.SSLError
        raise LinkError(f"{named} in {folder}; copy the files of {role} again from where they were made") from None
    return context


def _speaks_tls(host: str, port: int) -> bool:
    import ssl

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
    """Run a handshake as Zenoh does, and wait briefly for the other end's reply to this certificate."""
    import ssl

    try:
        with socket.create_connection((host, port), _TLS_TIMEOUT_S) as plain:
            try:
                secure = context.wrap_socket(plain, server_hostname=host)
            except TimeoutError:
                return _SILENT
            with secure:
                secure.recv(1)
    except ssl.SSLError as error:
        return next((words for sign, words in _CAUSES if sign in str(error)), f"TLS: {error.reason}")
    except OSError:
        return ""
    return ""
