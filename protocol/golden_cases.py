"""The golden cases, stated by hand: key, header, payload, and the refusal if there is one. Pure."""

from typing import Any

from sightline.protocol.channels import CHANNELS
from sightline.protocol.golden_answers import answers, twists
from sightline.protocol.spec.message_cases import MALFORMED, USUAL, VERSION, MessageCase, case, packed, without
from sightline.protocol.golden_frames import frames, pictures, views
from sightline.protocol.golden_payloads import detections, missions, payloads, reports


def _usual() -> list[MessageCase]:
    return [case(channel, "usual", "a complete message") for channel in CHANNELS]


def _stamps() -> list[MessageCase]:
    """What holds for every header, on every channel."""
    return [one for channel in CHANNELS for one in _header_cases(channel, USUAL[channel][1])]


def _header_cases(channel: str, header: dict[str, Any]) -> list[MessageCase]:
    return [
        case(channel, "unknown_field", "unknown fields are ignored", header=header | {"later": [1]}),
        case(channel, "version_2", "another version is refused by name", VERSION, header=header | {"v": 2}),
        case(channel, "no_session", "a required field is missing", MALFORMED, header=without(header, "session")),
        case(channel, "session_upper", "8 lower-case hex", MALFORMED, header=header | {"session": "0A1B2C3D"}),
        case(channel, "seq_negative", "integers are bounded below", MALFORMED, header=header | {"seq": -1}),
        case(channel, "seq_2_53", "integers are bounded above", MALFORMED, header=header | {"seq": 2**53}),
        case(channel, "seq_text", "no type is converted", MALFORMED, header=header | {"seq": "7"}),
        case(channel, "header_cut", "cut short", MALFORMED, header=packed(header)[:-1]),
        case(channel, "header_513", "513 bytes of header", MALFORMED, header=packed(header).ljust(513)),
        case(channel, "header_512", "512 bytes of header", header=packed(header).ljust(512)),
    ]


CASES: tuple[MessageCase, ...] = (
    *_usual(), *_stamps(), *frames(), *pictures(), *twists(), *answers(), *payloads(), *detections(), *missions(),
    *reports(), *views(),
)
"""Every case; the first of a channel is its example in the specification."""
