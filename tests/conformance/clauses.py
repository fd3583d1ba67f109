"""The numbered clauses of the specification, as cases name them. Shell (reads a file)."""

import re
from pathlib import Path

README = Path(__file__).parent.parent.parent / "protocol" / "README.md"
_HEADING = re.compile(r"^##+ (?:(\d+)\. )?(.+)$")
_CLAUSE = re.compile(r"\*\*(\d+\.\d+)(?: ([^*]+?))?\.?\*\*")


UNTESTED = {
    "5.5 A picture that does not change": "the kit cannot freeze a robot's camera; tests/robot_side/safety",
    "5.6 Reasons": "the text that a peer shows to an operator is not on the wire; V-STAT-05 sends an unknown reason",
    "7.6 Loss": "a SHOULD, and the kit's links lose nothing; tests/robot_side/network/test_loss.py",
    "13.1 Security": "a link without keys promises clauses 5 and 6",
    "13.3 Zenoh": "a denial is silent; protocol/transports/test_security_zenoh.py tries every role on every channel",
    "13.4 WebSocket": "it sums up 14.2 and 14.3",
    "14.7 Newest only":
        "messages for a slow peer wait in the buffers of two machines; tests/protocol/transports/websocket",
    "15.4 Options": "the owner chooses; the golden vectors hold the legacy options",
    "15.5 On WebSocket: the legacy protocol": "the kit plays no such robot; tests/protocol/test_legacy_text.py",
    "15.6 Boxes": "the golden vectors `older_boxes` hold it",
    "16.1 On Zenoh": "priority and express are not seen at the other end; tests/protocol/transports/zenoh",
    "16.2 On Zenoh": "the session's configuration; tests/protocol/transports/zenoh",
    "16.3 On Zenoh": "it permits nothing and rejects nothing",
    "16.4 On Zenoh": "for information only; tests/protocol/transports/zenoh/test_presence.py",
    "16.5 Liveliness tokens": "keys without a case of their own: those of 6.8 declare tokens under them",
    "19.1 Overlay and preview":
        "for a vision service that draws for viewers, which is optional; tests/vision_side/test_viewing.py",
    "19.3 Passing on": "optional for a robot; tests/e2e/test_relay.py",
    "20.4 Sender": "for operators; tests/protocol/transports/test_stop_datagram.py",
    "20.6 Routers": "for routers; tests/operator_side/setup/test_router.py",
}
"""Clauses without a case of their own, and why; a test demands that all others have one."""


def clauses():
    """`7.4 Window` for a clause with a title of its own, `8.1 Requests and replies` for one under its section's."""
    found, section = [], ""
    for line in README.read_text("utf-8").splitlines():
        heading = _HEADING.match(line)
        if heading is not None:
            section = heading[2]
            found += [f"{heading[1]}. {section}"] if heading[1] else []
        found += [f"{number} {title or section}" for number, title in _CLAUSE.findall(line)]
    return found
