"""Builds the golden vectors and checks that the decoders agree with each of them. Pure.

`message_cases.py` and `framing_cases.py` define each case and its result by hand. A file is written only if the
decoders agree. A message is in `vectors/<channel>/<case>.json`:

    `{"purpose", "key", "header_hex", "payload_hex", "accept": {"source", "header", "payload"} or "refuse": reason}`

`header` and `payload` are decoded, with defaults filled in; `null` is an absent optional header. The payload of an
image is its size, of a scan the ranges, with "inf" for no return. Cases of `framing_cases.py` are in separate folders.
They have their own input fields in place of key, header and payload, and their results.
"""

import json
import math
from pathlib import Path
from typing import Any

from sightline.protocol.channels import ACK, JPEG, SCAN, TWIST, Channel, parse_key
from sightline.protocol.codec import check_sizes, decode, decode_ranges
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.spec.framing_cases import FRAMING_CASES, FramingCase, framing_outcome
from sightline.protocol.spec.message_cases import CASES, MessageCase
from sightline.protocol.text import parse_twist

INEXACT_KEY = "INEXACT_KEY"
"""Result for a key that is not exact. The receiver counts it and sends no reply."""
Outcome = dict[str, Any]


def outcome(key: str, header: bytes, payload: bytes) -> Outcome:
    """Return the result at a receiver, `{"accept": {...}}` or `{"refuse": reason}`. Never raises."""
    parsed = parse_key(key)
    if parsed is None:
        return {"refuse": INEXACT_KEY}
    _, channel, source = parsed
    try:
        check_sizes(channel, header, payload)
        read_header = _read_header(channel, source, header)
        return {"accept": {"source": source, "header": read_header, "payload": _read_payload(channel, payload)}}
    except WireError as error:
        return {"refuse": str(error.reason)}


def _read_header(channel: Channel, source: str, header: bytes) -> Outcome | None:
    if channel is TWIST and source == "guest" and not header:
        return None
    model = channel.header
    read = decode(model, header)
    return read.model_dump(mode="json")


def _read_payload(channel: Channel, payload: bytes) -> Any:
    if channel.encoding == JPEG:
        size = read_jpeg_size(payload)
        return {"width_px": size.width_px, "height_px": size.height_px, "components": size.components}
    if channel is TWIST:
        return parse_twist(payload).model_dump()
    if channel is SCAN:
        return ["inf" if math.isinf(value) else value for value in decode_ranges(payload)]
    if channel is ACK or channel.payload is None:
        return None
    return decode(channel.payload, payload, channel.max_payload_bytes).model_dump(mode="json")


def vector(case: MessageCase) -> Outcome:
    """Return the content of the case's file. Raises ValueError if the decoders disagree with the case."""
    got = outcome(case.key, case.header, case.payload)
    if got.get("refuse") != case.refuse:
        raise ValueError(f"{case.channel}/{case.name}: stated {case.refuse or 'accept'}, decoded to {got}")
    return {
        "purpose": case.purpose,
        "key": case.key,
        "header_hex": case.header.hex(),
        "payload_hex": case.payload.hex(),
        **got,
    }


def _wire_vector(case: FramingCase) -> Outcome:
    got = framing_outcome(case.folder, case.given)
    if got.get("refuse") != case.refuse:
        raise ValueError(f"{case.folder}/{case.name}: stated {case.refuse or 'accept'}, decoded to {got}")
    return {"purpose": case.purpose, **case.given, **got}


def files() -> dict[Path, str]:
    """Return every vector file below `vectors/` and its text."""
    vectors = {Path(case.channel, case.name): vector(case) for case in CASES}
    vectors |= {Path(case.folder, case.name): _wire_vector(case) for case in FRAMING_CASES}
    return {Path(f"{path}.json"): _text(contents) + "\n" for path, contents in vectors.items()}


def _text(contents: Outcome) -> str:
    return json.dumps(contents, indent=1, ensure_ascii=False)


def vector_table() -> str:
    """Count the vectors of each folder in a Markdown table."""
    stated = [(case.channel, case.refuse) for case in CASES] + [(case.folder, case.refuse) for case in FRAMING_CASES]
    rows = ["| folder | accepted | rejected |", "|---|---|---|"]
    for folder in dict.fromkeys(name for name, _ in stated):
        accepted = sum(name == folder and refuse is None for name, refuse in stated)
        refused = sum(name == folder for name, _ in stated) - accepted
        rows.append(f"| `vectors/{folder}/` | {accepted} | {refused} |")
    return "\n".join(rows) + "\n"


def examples() -> str:
    """Return the first vector of each channel, for the specification."""
    first = {case.channel: case for case in reversed(CASES)}
    blocks = [
        f"`vectors/{case.channel}/{case.name}.json`, {case.purpose}:\n\n```json\n"
        + _text(vector(case))
        + f"\n```\n\nheader as text: `{case.header.decode()}`\n"
        for case in reversed(first.values())
    ]
    return "\n".join(blocks)

