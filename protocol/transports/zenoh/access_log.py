"""Who was turned away at a TLS endpoint and why, from Zenoh's own log, in words and in few lines. Pure.

Zenoh tells the peer by a TLS alert, and its own side only by a line of its log. The causes are those of rustls.
"""

from __future__ import annotations

import re
from typing import Final

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


