"""Golden cases of twists and acknowledgements. Pure."""

from sightline.protocol.spec.message_cases import (
    ANSWER,
    ECHO,
    INEXACT,
    MALFORMED,
    NOT_FINITE,
    PEER,
    MessageCase,
    case,
    echoing,
    without,
)

_TWISTS_GOOD = {
    "zero": b"0|0",
    "plus": b"+0.1|+0.2",
    "integer": b"1|-2",
    "bare_point": b".5|5.",
    "exponent": b"2e-1|1E+0",
    "seventeen_digits": b"2.3028209556706964|0",
    "too_fast": b"48|48",
    "minus_zero": b"-0.0000|0.0000",
    "underflow": b"1e-999|0",
    "bytes_64": b"0." + b"0" * 29 + b"|0." + b"0" * 30,
}
_TWISTS_MALFORMED = {
    "empty": b"",
    "one_number": b"0.1",
    "three_numbers": b"1|2|3",
    "comma": b"0,1|0",
    "minus_joined": b"0.1-0.2",
    "blank": b"0.1| 0.2",
    "newline": b"0.1|0.2\n",
    "nul": b"0.1|0.2\x00",
    "underscore": b"1_0|2",
    "hexadecimal": b"0x1p3|0",
    "two_signs": b"--1|0",
    "point_alone": b".|0",
    "exponent_alone": b"e5|0",
    "exponent_4_digits": b"1e0001|0",
    "arabic_digits": "٣|٠".encode(),
    "full_width_digits": "１|０".encode(),
    "unicode_minus": "−1|0".encode(),
    "byte_order_mark": b"\xef\xbb\xbf0|0",
    "bytes_65": b"0." + b"0" * 30 + b"|0." + b"0" * 30,
    "json": b'{"linear":0.1}',
}
_TWISTS_NOT_FINITE = {"nan": b"nan|0", "inf": b"0|inf", "minus_infinity": b"-Infinity|0", "overflow": b"1e999|0"}


def twists() -> list[MessageCase]:
    good = [case("twist", f"text_{name}", "within the grammar", payload=text) for name, text in _TWISTS_GOOD.items()]
    bad = [
        case("twist", f"text_{name}", "outside the grammar", MALFORMED, payload=text)
        for name, text in _TWISTS_MALFORMED.items()
    ]
    return [*good, *bad] + [
        case("twist", f"text_{name}", "not a finite number", NOT_FINITE, payload=text)
        for name, text in _TWISTS_NOT_FINITE.items()
    ]


def answers() -> list[MessageCase]:
    guest = "sightline/r1/twist/guest"
    return [
        case("twist", "guest", "a guest needs no header", header=b"", key=guest),
        case("twist", "no_header", "any other role needs one", MALFORMED, header=b""),
        case("twist", "no_compute", "compute_us may be left out", header=without(ANSWER, "compute_us")),
        case("twist", "with_scan_and_mission", "what else it went by",
             header=ANSWER | {"scan": 12, "mission": {"session": PEER, "id": 5}}),
        case("twist", "scan_negative", "integers are bounded below", MALFORMED, header=ANSWER | {"scan": -1}),
        case("twist", "mission_no_id", "named in full", MALFORMED, header=ANSWER | {"mission": {"session": PEER}}),
        case("twist", "no_echo", "a twist must cite what it answers", MALFORMED, header=without(ANSWER, "echo")),
        case("twist", "echo_of_scan", "no scan is cited", MALFORMED, header=echoing(ECHO | {"channel": "scan"})),
        case("twist", "echo_no_time", "an echo is complete", MALFORMED, header=echoing(without(ECHO, "t_us"))),
        case("twist", "source_upper", "a role is lower-case", MALFORMED, header=ANSWER | {"source": "Vision"}),
        case("twist", "source_long", "at most 16 characters", MALFORMED, header=ANSWER | {"source": "v" * 17}),
        case("twist", "wildcard", "a wildcard for the role", INEXACT, key="sightline/r1/twist/*"),
        case("twist", "wildcard_all", "a wildcard for all", INEXACT, key="**"),
        case("twist", "no_source", "a key without its role", INEXACT, key="sightline/r1/twist"),
        case("twist", "deeper", "a key with one part more", INEXACT, key="sightline/r1/twist/vision/1"),
        case("twist", "key_upper", "a role in the key is lower-case", INEXACT, key="sightline/r1/twist/Vision"),
        case("ack", "with_payload", "an ack has no payload", MALFORMED, payload=b"0|0"),
    ]
