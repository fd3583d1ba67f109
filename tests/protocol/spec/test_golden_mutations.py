"""Every accepted golden vector, cut short at every byte and with every bit of its header flipped.

The result is always a value within the bounds of the specification, or a rejection with one of its reasons.
"""

import math

import pytest

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import MAX_INTEGER
from sightline.protocol.spec.framing_cases import FRAMING_CASES, framing_outcome
from sightline.protocol.spec.golden import INEXACT_KEY, outcome
from sightline.protocol.spec.message_cases import CASES

ACCEPTED = [case for case in CASES if case.refuse is None]
WIRED = [case for case in FRAMING_CASES if case.refuse is None]
REASONS = {*map(str, RejectReason), INEXACT_KEY}
LONGEST_TEXT = 4_096
WHOLE_UP_TO = 2_000  # longer payloads (bounds padded with blanks, 64 boxes) are cut at every 61st byte


def flipped(data):
    """`data` with each of its bits changed, one at a time."""
    for at in range(len(data)):
        for bit in range(8):
            yield data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]


def cut(data):
    """All beginnings of `data` but the whole."""
    return (data[:length] for length in range(0, len(data), 1 if len(data) <= WHOLE_UP_TO else 61))


def check(got):
    """`got` is one of the two outcomes that there are."""
    assert len(got) == 1
    if "refuse" in got:
        assert got["refuse"] in REASONS
    else:
        within_bounds(got["accept"])
    return "refuse" in got


def within_bounds(value):
    if isinstance(value, dict):
        assert value.get("v", 1) == 1
        for name, inner in value.items():
            within_bounds(name)
            within_bounds(inner)
    elif isinstance(value, list | tuple):
        assert len(value) <= 4096
        for inner in value:
            within_bounds(inner)
    elif isinstance(value, float):
        assert math.isfinite(value)
    elif isinstance(value, int):
        assert 0 <= value <= MAX_INTEGER
    elif isinstance(value, str):
        assert len(value) <= LONGEST_TEXT
        value.encode()  # no half of a surrogate pair
    else:
        assert value is None


@pytest.mark.parametrize("case", ACCEPTED, ids=lambda case: f"{case.channel}/{case.name}")
def test_truncated_or_changed_message_is_read_or_rejected(case):
    rejected = [check(outcome(case.key, header, case.payload)) for header in (*cut(case.header), *flipped(case.header))]
    for payload in cut(case.payload):
        check(outcome(case.key, case.header, payload))
    assert not check(outcome(case.key, case.header, case.payload))
    if case.header:
        assert all(rejected[: len(case.header.rstrip())]), "the codec rejects a truncated header"
        assert any(not one for one in rejected) and rejected.count(True) > 100, "some bits do not matter, most do"


@pytest.mark.parametrize("case", [one for one in WIRED if one.folder == "websocket"], ids=lambda case: case.name)
def test_truncated_or_changed_websocket_message_is_split_or_rejected(case):
    message = bytes.fromhex(case.given["message_hex"])
    block = 2 + int.from_bytes(message[:2])
    changed = [one + message[block:] for one in flipped(message[:block])]
    for one in (*cut(message), *changed):
        got = framing_outcome("websocket", case.given | {"message_hex": one.hex()})
        check(got)
        if "accept" in got:
            assert len(got["accept"]["header_hex"]) // 2 <= 576 and len(one) >= len(got["accept"]["payload_hex"]) // 2
    for one in cut(message[:block]):
        assert check(framing_outcome("websocket", case.given | {"message_hex": one.hex()})), (
            "the codec rejects a truncated block"
        )


@pytest.mark.parametrize(
    "case", [one for one in WIRED if "text" in one.given], ids=lambda case: f"{case.folder}/{case.name}"
)
def test_truncated_or_changed_text_is_read_or_rejected(case):
    """A transport hands over no text that is not UTF-8, so a changed byte stands for the character of that number."""
    text = case.given["text"].encode()
    for one in (*cut(text), *flipped(text)):
        check(framing_outcome(case.folder, case.given | {"text": one.decode("latin-1")}))


@pytest.mark.parametrize("case", [one for one in WIRED if one.folder == "stop"], ids=lambda case: case.name)
def test_truncated_or_changed_datagram_is_read_or_rejected(case):
    data = bytes.fromhex(case.given["datagram_hex"])
    for one in cut(data):
        assert "refuse" in framing_outcome("stop", case.given | {"datagram_hex": one.hex()})
    for one in flipped(data):
        got = framing_outcome("stop", case.given | {"datagram_hex": one.hex()})
        assert ("accept" in got) != ("refuse" in got)
        assert "refuse" in got or not case.given["secret_hex"], "with keys, no bit can be changed"
