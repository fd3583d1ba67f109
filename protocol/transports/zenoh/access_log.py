"""Reports TLS clients and messages that Zenoh rejected, read from Zenoh's own log. Shell.

Zenoh tells the peer by a TLS alert, and its own side only by a line of its log. The causes are those of rustls.
"""

from __future__ import annotations

import fcntl
import ipaddress
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from sightline.protocol.clock import monotonic_us
from sightline.protocol.log import JsonLineStream, RepeatLimiter
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint

TLS_LOG_FILTER: Final = "off,zenoh_link_tls=warn,zenoh_link_quic=warn,zenoh_link_commons::quic=warn"
"""What is asked of Zenoh's log about handshakes: nothing of it is written per message."""

_ANSI_COLORS: Final = re.compile(r"\x1b\[[0-9;]*m")
_LINE: Final = re.compile(r"\S+Z +(?:WARN|ERROR) .*?(?:zenoh_link_tls|zenoh_link_quic|zenoh_link_commons)\S*: (.*)")
_SAME_KEYS: Final = "use keys of one `sightline keys init` on both"
_OTHER: Final = f"its certificate is of another authority: {_SAME_KEYS}"
_UNKNOWN: Final = f"it does not know our certificate's authority: {_SAME_KEYS}"
_EXPIRED_HERE: Final = "it finds our certificate expired: sightline keys add DIR ROLE"
_ELSEWHERE: Final = (
    "our certificate does not name the address that it asked for: sightline keys add DIR ROLE --host ADDRESS"
)
_CLOSED_BY_PEER: Final = "ConnectionClosed"
_SAID_BY_PEER: Final = (
    ("expired", _EXPIRED_HERE),
    ("NotValidForName", _ELSEWHERE),
    ("not valid for", _ELSEWHERE),
    ("BadSignature", _UNKNOWN),
    ("UnknownIssuer", _UNKNOWN),
)
"""QUIC gives the peer's own words."""
_CAUSES: Final = (
    ("tls handshake eof", ""),  # it left before it said anything: a port scan, or the doctor's knocking
    ("connection reset", ""),
    ("corrupt message", "it does not speak TLS: connect it to tls/... with --secure DIR"),
    ("sent no certificates", "it shows no certificate: give it --secure DIR"),
    ("certificate expired", "its certificate has expired: sightline keys add DIR ROLE"),
    ("not valid yet", "its certificate is not valid yet: is the clock of one of the two machines wrong?"),
    ("UnknownIssuer", _OTHER),
    ("BadSignature", _OTHER),
    ("alert: UnknownCA", _UNKNOWN),
    ("alert: DecryptError", _UNKNOWN),
    ("alert: CertificateExpired", _EXPIRED_HERE),
    ("alert: BadCertificate", _ELSEWHERE),
    ("alert: CertificateUnknown", _ELSEWHERE),
    ("timeout", "it opened a connection and said nothing"),
)
_HINT: Final = ". Hint: increase the system open file limit."
_LONGEST_WORDS: Final = 120
def refusal_cause(line: str) -> str | None:
    """Why somebody was turned away; "" for what is not worth a word; None for a line that says nothing of it."""
    said = _LINE.match(_ANSI_COLORS.sub("", line))
    if said is None:
        return None
    text = said[1].removesuffix(_HINT)
    for sign, words in _SAID_BY_PEER if _CLOSED_BY_PEER in text else _CAUSES:
        if sign.lower() in text.lower():
            return words
    return f"TLS: {text[:_LONGEST_WORDS]}"


# Who is connected with which certificate, and what access rules turned away, from Zenoh's own log. Pure.
#
# Zenoh tells nobody that it dropped a publication or subscription which a certificate's role does not have: not the
# peer, and its own side only by a line without a name. So the certificates of those who are connected stand beside it.


ACCESS_LOG_FILTER: Final = (
    "zenoh_link_tls::unicast=debug,zenoh_link_quic::unicast=debug,"
    "zenoh::net::routing::interceptor=trace,zenoh::net::routing::interceptor::access_control=off"
)
"""A line for each connection, and one for each message that is turned away; none for what passes."""
WHY: Final = "a certificate's role may not say or hear that, or it is too large (docs/security.md)"

DENIED: Final = b"Msg intercepted!"
"""How the line about a message that was turned away ends."""

_ANSI_ESCAPES: Final = re.compile(r"\x1b\[[0-9;]*m")
_OURS: Final = re.compile(r"\S+Z +(?:DEBUG|TRACE) .*?(?:zenoh_link_(?:tls|quic)::|zenoh::net::routing::interceptor)")
_ACCEPTED: Final = re.compile(r"Accepted \S+ connection on \S+: (\S+):(\d+)\. Common Name: (.*)\.$")
_MOST_ENDS: Final = 256
"""Security limit: four times as many as Zenoh lets in at once."""
_MOST_NAMED: Final = 4


class Certificates:
    """What the log said of each far end, `address:port`, the newest last."""

    def __init__(self) -> None:
        self._roles: dict[str, str] = {}

    def note(self, line: str) -> bool:
        """Take a line of the log; False for one that `LOG_FILTER` did not ask for."""
        text = _ANSI_ESCAPES.sub("", line).rstrip()
        if _OURS.match(text) is None:
            return False
        accepted = _ACCEPTED.search(text)
        if accepted is not None:
            host, port, role = accepted.groups()
            self._keep(f"{host.strip('[]').removeprefix('::ffff:')}:{port}", role)
        return True

    def connected(self, ends: Collection[str]) -> str:
        """`viewer from 192.168.1.7 or vision from ...` for those of `ends` that are known; "" for none."""
        named = [f"{role} from {end.rpartition(':')[0]}" for end, role in self._roles.items() if end in ends]
        newest = list(dict.fromkeys(reversed(named)))
        more = f" or {len(newest) - _MOST_NAMED} others" if len(newest) > _MOST_NAMED else ""
        return " or ".join(newest[:_MOST_NAMED]) + more

    def _keep(self, end: str, role: str) -> None:
        self._roles.pop(end, None)
        self._roles[end] = "".join(sign for sign in role[:32] if sign.isprintable())
        if len(self._roles) > _MOST_ENDS:
            del self._roles[next(iter(self._roles))]


# Who comes to a TCP port and leaves it again, from the kernel's table. Shell (reads /proc, waits; Linux only).


TABLES: Final = Path("/proc/net")
_LISTENS: Final = "0A"
_LEAVING: Final = ("04", "05", "06", "07", "08", "09", "0B")
"""FIN_WAIT1, FIN_WAIT2, TIME_WAIT, CLOSE, CLOSE_WAIT, LAST_ACK, CLOSING."""
_LOOK_S: Final = 0.005
"""A TLS handshake takes longer than this on any radio."""


class Visitors:
    """Names hosts whose connections to `ports` did not last. Looks only while it is asked."""

    def __init__(self, ports: Collection[int]) -> None:
        self._ports = ports
        self._left: set[str] = set()

    def who_left(self, patience_s: float) -> str:
        """The host of a connection that ends, or comes and ends, within `patience_s`; "" for none or for several."""
        ends_s, stay = time.monotonic() + patience_s, {end for end, leaves in self._ends().items() if not leaves}
        came: set[str] = set()
        while True:
            ends = self._ends()
            leaving = {end for end, leaves in ends.items() if leaves}
            left = (leaving | (came - ends.keys())) - self._left
            self._left = leaving | left  # a number may come again when the kernel has forgotten it
            if left:
                hosts = {end.rpartition(":")[0] for end in left}
                return hosts.pop() if len(hosts) == 1 else ""
            came |= ends.keys() - stay - leaving
            if time.monotonic() >= ends_s:
                return ""
            time.sleep(_LOOK_S)

    def here(self) -> set[str]:
        """`address:port` of the far ends of connections that last."""
        return {end for end, leaves in self._ends().items() if not leaves}

    def _ends(self) -> dict[str, bool]:
        """`address:port` of the far ends of connections to our ports, and whether they are ending."""
        rows = [row for table in ("tcp", "tcp6") for row in _rows(table)]
        ours = [row for row in rows if int(row[1].rpartition(":")[2], 16) in self._ports and row[3] != _LISTENS]
        return {_address(row[2]): row[3] in _LEAVING for row in ours}


def _rows(table: str) -> list[list[str]]:
    try:
        return [line.split() for line in (TABLES / table).read_text("ascii").splitlines()[1:]]
    except OSError:
        return []


def _address(text: str) -> str:
    """The kernel writes each 32 bits of an address in the machine's own order, in hex digits."""
    digits, _, port = text.rpartition(":")
    words = [bytes.fromhex(digits[start:start + 8])[::-1] for start in range(0, len(digits), 8)]
    host = ipaddress.ip_address(b"".join(words))
    return f"{getattr(host, 'ipv4_mapped', None) or host}:{int(port, 16)}"


# What Zenoh turns away at a TLS endpoint, and behind it, said by the service that listens there. Shell (a pipe).
#
# Zenoh writes its log to the process's standard output and nowhere else. So that descriptor is given a pipe, the
# service's own lines keep the real one, and whatever is not Zenoh's goes on as it came.


_STDOUT = 1
_GULP_BYTES = 1_048_576  # what an unprivileged pipe can hold; one that is full costs lines
_GULP_S = 0.02
_LOOKS_S = 0.6  # Zenoh does not say who it was; who is refused tries again within this, or is in the kernel's table


@contextmanager
def log_rejected_peers(listen: Sequence[str], secure: str, say: Callable[[str], None]) -> Iterator[None]:
    """While inside, `say` who is turned away at the secured ones of `listen`, and why. Enter it before the link opens.

    For a process of its own: its standard output is redirected.
    """
    doors = [endpoint for endpoint in listen if endpoint.startswith(("tls/", "quic/"))]
    if not (secure and doors):
        yield
        return
    try:
        import zenoh
    except ImportError:  # whoever opens the link says so
        yield
        return
    with _own_stdout() as read_end:
        zenoh.init_log_from_env_or(f"{TLS_LOG_FILTER},{ACCESS_LOG_FILTER}")
        told = _LogReader(doors, say)
        threading.Thread(target=told.read, args=(read_end,), name="zenoh-log", daemon=True).start()
        yield


class _LogReader:
    """Reads the log line by line."""

    def __init__(self, doors: Sequence[str], say: Callable[[str], None]) -> None:
        self._doors, self._say = doors, say
        self._visitors = Visitors({parse_zenoh_endpoint(door)[2] for door in doors})
        self._lines = RepeatLimiter()
        self._certificates = Certificates()

    def read(self, read_end: int) -> None:
        """Until the pipe ends; in gulps, for whoever floods what it may not say causes a line each time."""
        rest = b""
        with os.fdopen(read_end, "rb", buffering=0) as log, suppress(OSError, ValueError):
            while gulp := log.read(_GULP_BYTES):
                *lines, rest = (rest[-_GULP_BYTES:] + gulp).split(b"\n")
                self._take(lines)
                time.sleep(_GULP_S)

    def _take(self, lines: list[bytes]) -> None:
        others = [line for line in lines if not line.endswith(DENIED)]
        for line in others:
            self._line(line.decode("utf-8", "replace"))
        if len(others) < len(lines):
            self._tell_denied(len(lines) - len(others))

    def _line(self, line: str) -> None:
        if self._certificates.note(line):
            return
        cause = refusal_cause(line)
        if cause is None:
            print(line, flush=True)
            return
        often = self._often(cause, 1)
        if often is not None:
            who = self._visitors.who_left(_LOOKS_S)
            from_whom = f" from {who}" if who else ""
            self._say(f"refused a connection{from_whom} at {', '.join(self._doors)}{often}: {cause}")

    def _tell_denied(self, times: int) -> None:
        often = self._often(WHY, times)
        if often is not None:
            who = self._certificates.connected(self._visitors.here())
            of_whom = f" of {who}" if who else ""
            self._say(f"refused a message{of_whom} at {', '.join(self._doors)}{often}: {WHY}")

    def _often(self, cause: str, times: int) -> str | None:
        """How often since the last line about `cause`, in words; None if no line is due."""
        told = self._lines.is_due(cause, monotonic_us(), times) if cause else 0
        return None if not told else f" ({told} times)" if told > 1 else ""


@contextmanager
def _own_stdout() -> Iterator[int]:
    """A pipe in place of the standard output, which our own `print` keeps; gives the pipe's end to read from."""
    sys.stdout.flush()
    before, kept = sys.stdout, os.dup(_STDOUT)
    read_end, write_end = os.pipe()
    with suppress(OSError):
        fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, _GULP_BYTES)
    os.set_blocking(write_end, False)  # a reader that is late costs lines of a log, never the link
    os.dup2(write_end, _STDOUT)
    os.close(write_end)
    ours = open(kept, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)  # noqa: SIM115
    sys.stdout = before.over(ours) if isinstance(before, JsonLineStream) else ours
    try:
        yield read_end
    finally:
        sys.stdout.flush()
        sys.stdout = before
        os.dup2(kept, _STDOUT)
        os.close(kept)
