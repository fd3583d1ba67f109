"""Who was turned away at a TLS endpoint and why, from Zenoh's own log, in words and in few lines. Pure.

Zenoh tells the peer by a TLS alert, and its own side only by a line of its log. The causes are those of rustls.
"""

from __future__ import annotations

import re
from typing import Final

LOG_FILTER: Final = "off,zenoh_link_tls=warn,zenoh_link_quic=warn,zenoh_link_commons::quic=warn"
"""What is asked of Zenoh's log about handshakes: nothing of it is written per message."""

_COLOURS: Final = re.compile(r"\x1b\[[0-9;]*m")
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
_FIRST_PERIOD_US: Final = 1_000_000
_LONGEST_PERIOD_US: Final = 60_000_000
_MOST_CAUSES: Final = 16


def refusal_cause(line: str) -> str | None:
    """Why somebody was turned away; "" for what is not worth a word; None for a line that says nothing of it."""
    said = _LINE.match(_COLOURS.sub("", line))
    if said is None:
        return None
    text = said[1].removesuffix(_HINT)
    for sign, words in _SAID_BY_PEER if _CLOSED_BY_PEER in text else _CAUSES:
        if sign.lower() in text.lower():
            return words
    return f"TLS: {text[:_LONGEST_WORDS]}"


class RefusalLines:
    """Per cause a line at once, then after 1, 2, 4 ... 60 s for as long as it goes on, each with how often."""

    def __init__(self) -> None:
        self._untold: dict[str, int] = {}
        self._told: dict[str, tuple[int, int]] = {}

    def is_due(self, cause: str, now_us: int, times: int = 1) -> int:
        """`cause` was given `times` more: how often since the last line about it, if one is due; else 0."""
        self._untold[cause] = self._untold.get(cause, 0) + times
        told_us, period_us = self._told.get(cause, (now_us - _FIRST_PERIOD_US, 0))
        silent_us = now_us - told_us
        if silent_us < period_us:
            return 0
        if silent_us > 2 * _LONGEST_PERIOD_US or not period_us:
            period_us = _FIRST_PERIOD_US // 2
        self._told[cause] = (now_us, min(2 * period_us, _LONGEST_PERIOD_US))
        if len(self._told) > _MOST_CAUSES:
            self._forget_oldest()
        return self._untold.pop(cause)

    def _forget_oldest(self) -> None:
        oldest = min(self._told, key=lambda cause: self._told[cause][0])
        del self._told[oldest]
        self._untold.pop(oldest, None)
