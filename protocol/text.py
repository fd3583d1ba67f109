"""Write and read the payload of a twist, the text `linear|angular`. Pure.

`float()` accepts nan, inf, `1_0`, blanks and digits of other scripts. None of these may reach a wheel.
Grammar: NUMBER "|" NUMBER, NUMBER = [+-] (DIGITS [. DIGITS*] | . DIGITS) [(e|E) [+-] 1*3DIGIT].
"""

import math
import re

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import Twist

MAX_TWIST_BYTES = 64

NUMBER = rb"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?"
_TWIST = re.compile(rb"(%b)\|(%b)" % (NUMBER, NUMBER))
_NON_FINITE = re.compile(rb"[+-]?(?:nan|inf|infinity)", re.IGNORECASE)


def format_twist(twist: Twist) -> bytes:
    """Write a twist as `linear|angular` (m/s, rad/s) with four decimals. It never writes `-0.0000`."""
    return f"{_decimals(twist.linear_mps)}|{_decimals(twist.angular_rad_s)}".encode("ascii")


def _decimals(value: float) -> str:
    text = f"{value:.4f}"
    return "0.0000" if text == "-0.0000" else text


def parse_twist(data: bytes) -> Twist:
    """Read `linear|angular`.

    Args:
        data: ASCII text, at most 64 bytes.

    Returns:
        The twist, m/s and rad/s.

    Raises:
        WireError: MALFORMED outside the grammar or above 64 bytes, NOT_FINITE for nan, inf or an overflow.
    """
    if len(data) > MAX_TWIST_BYTES:
        raise WireError(RejectReason.MALFORMED, f"twist text is {len(data)} bytes, at most {MAX_TWIST_BYTES}")
    match = _TWIST.fullmatch(data)
    if match is None:
        raise _rejection(data)
    linear, angular = float(match[1]), float(match[2])
    if not (math.isfinite(linear) and math.isfinite(angular)):
        raise WireError(RejectReason.NOT_FINITE, f"twist {data!r} overflows")
    return Twist(linear_mps=linear, angular_rad_s=angular)


def _rejection(data: bytes) -> WireError:
    fields = data.split(b"|")
    if len(fields) == 2 and any(_NON_FINITE.fullmatch(field) for field in fields):
        return WireError(RejectReason.NOT_FINITE, f"twist {data!r} is not finite")
    return WireError(RejectReason.MALFORMED, f"twist {data!r} is not `linear|angular`, e.g. 0.2000|-0.3500")
