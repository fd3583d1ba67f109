"""Golden cases of WebSocket framing, of hellos, and of the texts of the legacy protocol. Pure.

Each folder of cases has one kind of input, `given`, and one kind of result:

    websocket      a binary message from a peer with `robot` and `role` in its hello -> key, header, payload
    hello          the text of a hello -> its fields
    older_picture  base64 text, at most `max_bytes` of image -> the bytes of the JPEG
    older_dashed   `linear-angular` -> the twist
    older_boxes    boxes joined by `-` -> the boxes
    stop           a datagram of the STOP port and the STOP secret, empty without keys -> its fields
"""

import dataclasses
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from sightline.protocol.errors import WireError
from sightline.protocol.spec.message_cases import (
    ANSWER,
    ECHO,
    FRAME_HEADER,
    MALFORMED,
    NOT_FINITE,
    PEER,
    VERSION,
    jpeg,
    packed,
    without,
)
from sightline.protocol.transports.stop_datagram import (
    DATAGRAM_BYTES,
    STATES,
    Kind,
    StopDatagram,
    check_hmac,
    pack_stop,
    unpack_stop,
)
from sightline.protocol.transports.websocket.framing import MAX_BLOCK_BYTES, MAX_HELLO_BYTES, parse_hello, unpack
from sightline.protocol.transports.websocket.legacy_text import (
    decode_picture,
    encode_picture,
    parse_boxes,
    parse_dashed,
)

Fields = dict[str, Any]
WRONG_KEY: Final = "WRONG_KEY"


@dataclass(frozen=True, slots=True)
class FramingCase:
    """One input from the wire and its required result. `refuse` is None for an accepted input."""

    folder: str
    name: str
    purpose: str
    given: Fields
    refuse: str | None


def _unpacked(given: Fields) -> Fields:
    packet = unpack(bytes.fromhex(given["message_hex"]), given["robot"], given["role"])
    return {"key": packet.key, "header_hex": packet.header.hex(), "payload_hex": packet.payload.hex()}


def _greeted(given: Fields) -> Fields:
    return parse_hello(given["text"]).model_dump(mode="json")


def _pictured(given: Fields) -> Fields:
    return {"jpeg_hex": decode_picture(given["text"].encode(), given["max_bytes"]).hex()}


def _dashed(given: Fields) -> Fields:
    return parse_dashed(given["text"].encode()).model_dump()


def _boxed(given: Fields) -> Fields:
    return {"boxes": [dataclasses.asdict(box) for box in parse_boxes(given["text"].encode())]}


def _stopped(given: Fields) -> Fields:
    data, secret = bytes.fromhex(given["datagram_hex"]), bytes.fromhex(given["secret_hex"])
    one = unpack_stop(data)
    if secret:
        check_hmac(data, secret)
    fields = one._asdict() | {"kind": int(one.kind), "state": STATES[one.state]}
    return {"challenge_hex" if name == "challenge" else name: value.hex() if name == "challenge" else value
            for name, value in fields.items()}


READERS: Final[dict[str, Callable[[Fields], Fields]]] = {
    "websocket": _unpacked,
    "hello": _greeted,
    "older_picture": _pictured,
    "older_dashed": _dashed,
    "older_boxes": _boxed,
    "stop": _stopped,
}


def framing_outcome(folder: str, given: Fields) -> Fields:
    """Return the result at a receiver, `{"accept": {...}}` or `{"refuse": reason}`. Never raises."""
    try:
        return {"accept": READERS[folder](given)}
    except WireError as error:
        return {"refuse": str(error.reason)}


# --- sightline.v1 ------------------------------------------------------------------------------------------------

TWIST_BLOCK = b'{"channel":"twist",' + packed(ANSWER)[1:]
FRAME_BLOCK = b'{"channel":"frame",' + packed(FRAME_HEADER)[1:]
HELLO: Fields = {"v": 1, "robot": "r1", "role": "vision", "session": PEER, "wants": ["frame", "camera", "status"]}


def framed(block: bytes, payload: bytes = b"0.2000|-0.3500", size: int | None = None) -> bytes:
    """Return one binary message. `size` replaces the length by a false one."""
    return struct.pack(">H", len(block) if size is None else size) + block + payload


def _message(name: str, purpose: str, message: bytes, refuse: str | None = None, role: str = "vision") -> FramingCase:
    return FramingCase("websocket", name, purpose, {"robot": "r1", "role": role, "message_hex": message.hex()}, refuse)


def _messages() -> list[FramingCase]:
    late = packed(ANSWER | {"channel": "twist"})
    alone = b'{"channel":"twist","source":"guest"}'
    return [
        _message("twist", "the channel stands first", framed(TWIST_BLOCK)),
        _message("frame", "a robot's key has no role", framed(FRAME_BLOCK, jpeg(640, 480)), role="robot"),
        _message("channel_last", "the whole block is the header", framed(late)),
        _message("no_header", "a guest without a header", framed(alone), role=""),
        _message("no_header_role", "the hello's role is the source", framed(b'{"channel":"twist"}'), role="guest"),
        _message("header_after_it", "what follows is the header as it is", framed(alone + packed(ANSWER)), role=""),
        _message("header_broken", "the header is rejected later", framed(b'{"channel":"twist","v":1,')),
        _message("header_empty", "nothing follows the channel", framed(b'{"channel":"twist",}')),
        _message("header_junk", "no quote follows the channel", framed(b'{"channel":"twist",junk')),
        _message("header_blank", "a blank follows the channel", framed(b'{"channel":"twist", "v":1,,}')),
        _message("source_of_header", "a header's source is before the role's", framed(TWIST_BLOCK), role="teleop"),
        _message("source_of_role", "no source in the header", framed(b'{"channel":"twist",' + packed(
            without(ANSWER, "source"))[1:])),
        _message("source_number", "an invalid source", framed(b'{"channel":"twist","source":7}')),
        _message("channel_twice", "the first one, as it stands first", framed(b'{"channel":"ack",' + late[1:], b"")),
        _message("unknown_channel", "an unknown channel: dropped later", framed(b'{"channel":"later","v":1}')),
        _message("payload_empty", "an ack", framed(b'{"channel":"ack",' + packed(ANSWER)[1:], b"")),
        _message("block_576", "576 bytes of block", framed(TWIST_BLOCK.ljust(MAX_BLOCK_BYTES))),
        _message("block_577", "577 bytes of block", framed(TWIST_BLOCK.ljust(MAX_BLOCK_BYTES + 1)), MALFORMED),
        _message("block_past_end", "a length beyond the message", framed(TWIST_BLOCK, b"", 400), MALFORMED),
        _message("length_cut", "one byte", b"\x00", MALFORMED),
        _message("empty", "no bytes", b"", MALFORMED),
        _message("block_empty", "no channel", framed(b""), MALFORMED),
        _message("no_channel", "an object that names none", framed(packed(ANSWER)), MALFORMED),
        _message("channel_number", "a channel that is not text", framed(b'{"channel":7}'), MALFORMED),
        _message("not_json", "no object", framed(b"channel=twist"), MALFORMED),
        _message("array", "no object", framed(b'["twist"]'), MALFORMED),
        _message("deep", "nested beyond reading", framed(b"[" * 500), MALFORMED),
    ]


def _hello(name: str, purpose: str, text: str | Fields, refuse: str | None = None) -> FramingCase:
    given = text if isinstance(text, str) else packed(text).decode()
    return FramingCase("hello", name, purpose, {"text": given}, refuse)


def _hellos() -> list[FramingCase]:
    usual = packed(HELLO).decode()
    return [
        _hello("usual", "from a vision service", HELLO),
        _hello("robot", "a robot's", HELLO | {"role": "robot", "wants": ["twist", "ack", "request"]}),
        _hello("least", "who only watches, and wants nothing yet", {"robot": "r1", "session": PEER}),
        _hello("unknown_wants", "of a newer peer", HELLO | {"wants": ["frame", "later"]}),
        _hello("unknown_field", "unknown fields are ignored", HELLO | {"later": True}),
        _hello("version_2", "another version is rejected by name", HELLO | {"v": 2}, VERSION),
        _hello("no_robot", "whose it is", without(HELLO, "robot"), MALFORMED),
        _hello("robot_wildcard", "an id, no pattern", HELLO | {"robot": "*"}, MALFORMED),
        _hello("role_upper", "a role is lower-case", HELLO | {"role": "Vision"}, MALFORMED),
        _hello("no_session", "a required field is missing", without(HELLO, "session"), MALFORMED),
        _hello("wants_32", "as many as may be", HELLO | {"wants": ["frame"] * 32}),
        _hello("wants_33", "one too many", HELLO | {"wants": ["frame"] * 33}, MALFORMED),
        _hello("text_1024", "1024 bytes", usual.ljust(MAX_HELLO_BYTES)),
        _hello("text_1025", "1025 bytes", usual.ljust(MAX_HELLO_BYTES + 1), MALFORMED),
        _hello("twist", "the legacy protocol on the wrong port", "0.2|0.1", MALFORMED),
        _hello("empty", "no text", "", MALFORMED),
        _hello("cut", "cut short", usual[:-1], MALFORMED),
        _hello("echo", "something else altogether", ECHO, MALFORMED),
    ]


# --- the legacy protocol -----------------------------------------------------------------------------------------

_PICTURE: Final = jpeg(640, 480) + bytes(range(256))
_LINES: Final = encode_picture(_PICTURE).decode()


def _picture(name: str, purpose: str, text: str, refuse: str | None = None) -> FramingCase:
    return FramingCase("older_picture", name, purpose, {"max_bytes": len(_PICTURE), "text": text}, refuse)


def _pictures() -> list[FramingCase]:
    flat = _LINES.replace("\n", "")
    return [
        _picture("lines_of_76", "a newline after every 76 characters and at the end", _LINES),
        _picture("one_line", "no newlines", flat),
        _picture("crlf", "line ends of two characters", _LINES.replace("\n", "\r\n")),
        _picture("no_last_newline", "none at the end", _LINES.rstrip("\n")),
        _picture("empty", "no image: rejected as a frame, not as base64", ""),
        _picture("blank", "a blank is not base64", flat[:76] + " " + flat[76:], MALFORMED),
        _picture("url_alphabet", "the other alphabet", flat.replace("+", "-").replace("/", "_"), MALFORMED),
        _picture("padding_missing", "cut short", flat.rstrip("=")[:-1], MALFORMED),
        _picture("padding_early", "something after the end", "/9g=" + flat, MALFORMED),
        _picture("too_large", "a byte of picture too much", encode_picture(_PICTURE + b"x").decode(), MALFORMED),
        _picture("not_ascii", "digits of another script", "٣" * 8, MALFORMED),
    ]


_DASHED_GOOD: Final = {
    "plain": "0.2-0.35",
    "angular_negative": "0.2--0.35",
    "linear_negative": "-0.2-0.35",
    "both_negative": "-0.2--0.35",
    "exponents": "2e-1-3e-1",
    "exponent_and_minus": "1e-2--3E-3",
    "seventeen_digits": "2.3028209556706964-0",
}
_DASHED_MALFORMED: Final = {
    "bar": "0.2|0.35", "one_number": "0.2", "three": "1-2-3", "two_signs": "0.2---0.35", "empty": "",
    "blank": "0.2 -0.3", "bytes_65": "0." + "0" * 30 + "-0." + "0" * 30, "newline": "0.2-0.3\n",
}  # fmt: skip
_BOXES_GOOD: Final = {
    "one": "0.1000,0.2000,0.5000,0.6000",
    "two": "0.1,0.2,0.5,0.6-0,0,1,1",
    "none": "",
    "classed": "leg,0.2,0.1,0.6,0.5",
    "classed_and_plain": "person 2,0,0,1,1-0.1,0.2,0.5,0.6",
    "class_of_digits": "17,0.2,0.1,0.6,0.5",
    "sixteen": "-".join(["0,0,1,1"] * 16),
}
_BOXES_MALFORMED: Final = {
    "three_numbers": "0.1,0.2,0.5", "beyond": "0.1,0.2,0.5,1.1", "inside_out": "0.5,0.2,0.1,0.6", "nan": "nan,0,1,1",
    "negative": "-0.1,0,1,1", "no_class": ",0,0,1,1", "class_with_a_dot": "a.b,0,0,1,1",
    "classed_inside_out": "leg,0.6,0.1,0.2,0.5", "long_class": "x" * 33 + ",0,0,1,1", "six_fields": "leg,0,0,1,1,1",
    "seventeen": "-".join(["0,0,1,1"] * 17), "trailing": "0,0,1,1-", "exponent": "1e-1,0,1,1",
}  # fmt: skip


def _texts(folder: str, good: dict[str, str], bad: dict[str, str]) -> list[FramingCase]:
    return [
        *(FramingCase(folder, name, "within the grammar", {"text": text}, None) for name, text in good.items()),
        *(FramingCase(folder, name, "outside the grammar", {"text": text}, MALFORMED) for name, text in bad.items()),
    ]


# --- the STOP port -----------------------------------------------------------------------------------------------

_SECRET: Final = b"an example of a STOP secret"
_CHALLENGE: Final = bytes(range(16))
_STOP: Final = StopDatagram(Kind.STOP, "r1", 41, _CHALLENGE)
_ANSWER: Final = StopDatagram(Kind.ANSWER, "r1", 41, _CHALLENGE, STATES.index("STOPPED"), True, True, True, 7, 7)


def _datagram(
    name: str, purpose: str, data: bytes, refuse: str | None = None, secret: bytes = b""
) -> FramingCase:
    return FramingCase("stop", name, purpose, {"secret_hex": secret.hex(), "datagram_hex": data.hex()}, refuse)


def _changed(place: int, byte: int) -> bytes:
    data = bytearray(pack_stop(_STOP))
    data[place] = byte
    return bytes(data)


def _datagrams() -> list[FramingCase]:
    plain, signed = pack_stop(_STOP), pack_stop(_STOP, _SECRET)
    return [
        _datagram("stop", "without keys", plain),
        _datagram("query", "the request for the challenge", pack_stop(StopDatagram(Kind.STOP, "r1", 40))),
        _datagram("signed", "with keys", signed, secret=_SECRET),
        _datagram("answer", "stopped, wheels at zero, on disk", pack_stop(_ANSWER, _SECRET), secret=_SECRET),
        _datagram("answer_silent", "no driver process reports", pack_stop(_ANSWER._replace(state=0, at_rest=False))),
        _datagram("register", "from a robot to a router", pack_stop(_STOP._replace(kind=Kind.REGISTER))),
        _datagram("robot_32", "the longest id", pack_stop(_STOP._replace(robot="r" * 32))),
        _datagram("unsigned", "with keys, and no HMAC", plain, WRONG_KEY, _SECRET),
        _datagram("other_secret", "of another deployment", pack_stop(_STOP, b"another"), WRONG_KEY, _SECRET),
        _datagram("counter_changed", "signed for another counter", signed[:47] + b"*" + signed[48:], WRONG_KEY,
                  _SECRET),
        _datagram("empty", "no bytes", b"", MALFORMED),
        _datagram("cut", "a byte too short", plain[:-1], MALFORMED),
        _datagram("long", "a byte too long", plain.ljust(DATAGRAM_BYTES + 1), MALFORMED),
        _datagram("magic", "another protocol", _changed(0, 0x73), MALFORMED),
        _datagram("version_2", "another version is rejected by name", _changed(4, 2), VERSION),
        _datagram("kind_0", "an unknown kind", _changed(5, 0), MALFORMED),
        _datagram("state_7", "an unknown state", _changed(6, 7), MALFORMED),
        _datagram("robot_not_ascii", "an invalid id", _changed(8, 0xFF), MALFORMED),
    ]


FRAMING_CASES: tuple[FramingCase, ...] = (
    *_messages(),
    *_hellos(),
    *_pictures(),
    *_texts("older_dashed", _DASHED_GOOD, _DASHED_MALFORMED),
    FramingCase("older_dashed", "overflow", "not a finite number", {"text": "1e999-0"}, NOT_FINITE),
    *_texts("older_boxes", _BOXES_GOOD, _BOXES_MALFORMED),
    *_datagrams(),
)
"""Every case of framing, hellos, texts and datagrams."""
