"""The numbered clauses of the specification, as cases name them. Shell (reads a file)."""

import re
from pathlib import Path

README = Path(__file__).parent.parent.parent / "protocol" / "README.md"
_HEADING = re.compile(r"^##+ (?:(\d+)\. )?(.+)$")
_CLAUSE = re.compile(r"\*\*(\d+\.\d+)(?: ([^*]+?))?\.?\*\*")


UNTESTED = {
    "5.5 A picture that does not change": "the kit cannot hold a robot's camera still; tests/test_driver_*.py",
    "5.6 Reasons": "what a peer shows to a person is not on the wire; V-STAT-05 sends a reason that nobody knows",
    "12.1 Detections": "of who looks without steering; the golden vectors hold its bounds",
    "12.4 Steering by them": "of a vision that steers by another's boxes, which few do; tests/test_vision_*.py",
    "13.1 Security": "what a link without keys promises is clauses 5 and 6",
    "13.3 Zenoh": "a denial is silent; protocol/transports/test_security_zenoh.py tries every role on every channel",
    "13.4 WebSocket": "it sums up 14.2 and 14.3",
    "14.7 Newest only": "what waits for a slow peer lies in two machines' buffers; tests/protocol/transports/websocket",
    "15.4 Options": "an owner's choice; the golden vectors hold the dialects",
    "15.5 On WebSocket: the legacy protocol": "the kit plays no such robot; tests/protocol/test_legacy_text.py",
    "15.6 Boxes": "the golden vectors `older_boxes` hold it",
    "16.1 On Zenoh": "priority and express are not seen at the other end; tests/protocol/transports/zenoh",
    "16.2 On Zenoh": "the session's configuration; tests/protocol/transports/zenoh",
    "16.3 On Zenoh": "it allows nothing and refuses nothing",
    "16.4 On Zenoh": "a courtesy, by which nothing judges; tests/protocol/transports/zenoh/test_presence.py",
    "18.1 Request":
        "for a vision service that knows missions, which is optional; tests/vision_side/missions/test_registry.py",
    "18.2 Freshness": "as 18.1",
    "18.3 Switching": "as 18.1",
    "18.4 Report": "as 18.1",
    "19.1 Overlay and preview": "of a vision that draws for people, which none must; tests/vision_side/test_viewing.py",
    "19.2 Only while watched": "as 19.1",
    "19.3 Passing on": "a robot may leave it out; tests/e2e/test_relay.py",
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
