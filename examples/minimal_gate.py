"""Implement the gate of `minimal_robot.py`: accept commands, and compute the twist of the wheels. Pure.

Numbers in comments are clauses of protocol/README.md.
"""

import hashlib
import math
import re
import secrets
from collections import Counter
from typing import Any

SESSION = secrets.token_hex(4)
FULL_SPEED_US, MAX_AGE_US, SILENCE_US, LEASE_US, STATUS_US = 150_000, 400_000, 300_000, 1_000_000, 2_000_000
MAX_LINEAR_MPS, MAX_ANGULAR_RAD_S = 0.3, 1.5
MAX_FIRST_SEQ, MAX_JUMP = 2**32, 2**20
NOTHING = (0.0, 0.0, -MAX_AGE_US, -SILENCE_US)  # linear, angular, capture time of the frame, arrival time
NUMBER = rb"([+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?)"
TWIST = re.compile(NUMBER + rb"\|" + NUMBER)  # 4.1
Header = dict[str, Any]


def digest_of(source: str, session: str) -> str:
    """Return the public name of a driver or requester (6.7)."""
    return hashlib.sha256(f"{source}/{session}".encode()).hexdigest()[:8]


class Gate:
    """The only path to the wheels: validates a command on arrival, and again at each step."""

    def __init__(self) -> None:
        self.issued: dict[tuple[str, int], int] = {}  # 5.2: (channel, seq) -> t_us
        self.denied = -1  # 8.3: requests that cite a status up to this one permit no motion
        self.last_seq: dict[tuple[str, str], int] = {}
        self.holder, self.held_us, self.good = ("", ""), -LEASE_US, 0
        self.proof = (None, None)  # 6.6: the last proof of the holder, and the first of its next chain
        self.stopped, self.armed, self.arms_itself = False, False, True
        self.command = NOTHING
        self.accepted, self.refused = 0, Counter[str]()

    def offer(self, header: Header, text: bytes, now: int) -> None:
        try:
            reason = self.validate(header, text, now)
        except (KeyError, TypeError, ValueError):
            reason = "MALFORMED"
        self.refused[reason] += bool(reason)
        self.accepted += not reason

    def validate(self, header: Header, text: bytes, now: int) -> str:
        """Return the reason of 5.1 to reject a twist, or "" if it is accepted."""
        match, echo, who = TWIST.fullmatch(text[:65]), header["echo"], (header["source"], header["session"])
        linear, angular = (float(match[1]), float(match[2])) if match else (math.nan, math.nan)
        last = self.last_seq.get(who, -1)
        checks = {
            "UNSUPPORTED_VERSION": header.get("v", 1) == 1,
            "MALFORMED": match is not None and len(text) <= 64,
            "NOT_FINITE": math.isfinite(linear) and math.isfinite(angular),
            "UNKNOWN_SOURCE": who[0] in ("vision", "teleop"),
            **self.young(echo, "frame", now, MAX_AGE_US),
            "NOT_PROVEN": self.proven(header, now),
            "OUT_OF_ORDER": last < header["seq"] <= (MAX_FIRST_SEQ if last < 0 else last + MAX_JUMP),
        }
        wrong = next((reason for reason, holds in checks.items() if not holds), "")
        return wrong or self.take(who, header, (linear, angular, echo["t_us"], now))

    def proven(self, header: Header, now: int) -> bool:
        """Return True if a message with the driver's session continues its chain of proofs (6.6)."""
        element = header.get("proof")
        if not (self.live(now) and self.holder == (header["source"], header["session"]) and self.proof[0]):
            return element is None or len(bytes.fromhex(element)) == 16
        for _ in range(64 if element else 0):
            element = hashlib.sha256(bytes.fromhex(element)).hexdigest()[:32]
            if element in self.proof:
                return True
        return False

    def issue(self, channel: str, seq: int, t_us: int) -> None:
        """Record a message before it is sent, so that no peer can answer it earlier."""
        self.issued = dict([*self.issued.items(), ((channel, seq), t_us)][-512:])

    def young(self, echo: Header, channel: str, now: int, most_us: int) -> dict[str, bool]:
        """Return the checks of 5.1 on the cited message, by this robot's own record and clock."""
        own = self.issued.get((channel, echo["seq"])) == echo["t_us"]
        return {
            "OTHER_SESSION": echo["session"] == SESSION,
            "UNKNOWN_FRAME": echo["channel"] == channel and own,
            "FROM_FUTURE": echo["t_us"] <= now,
            "STALE": now - echo["t_us"] <= most_us,
        }

    def take(self, who: tuple[str, str], header: Header, command: tuple[float, float, int, int]) -> str:
        others = [one for one in self.last_seq.items() if one[0] not in (who, self.holder)]
        kept = [one for one in self.last_seq.items() if one[0] == self.holder]
        self.last_seq = dict([*others[-62:], *kept, (who, header["seq"])])  # 5.1: a rejected sender displaces no driver
        linear, angular, frame_us, now = command
        live = self.live(now)
        if self.stopped or (live and who != self.holder):  # 6.5, 6.1
            return "STOPPED" if self.stopped else "NOT_HOLDER"
        self.good = self.good + 1 if live else 1
        self.holder, self.held_us, self.proof = who, now, (header.get("proof"), header.get("next_proof"))
        if not self.armed:  # 6.4
            self.armed = self.arms_itself and self.good >= 5
            return "DISARMED"
        scale = max(1.0, abs(linear) / MAX_LINEAR_MPS, abs(angular) / MAX_ANGULAR_RAD_S)  # 4.3
        self.refused["CLAMPED"] += scale > 1
        self.command = (linear / scale, angular / scale, frame_us, now)
        return ""

    def live(self, now: int) -> bool:
        return now - self.held_us < LEASE_US

    def disarm(self) -> None:
        """Turn the wheels off. Only an operator can permit motion again."""
        self.armed, self.arms_itself, self.good, self.command = False, False, 0, NOTHING
        self.denied = max((seq for channel, seq in self.issued if channel == "status"), default=-1)

    def request(self, verb: str, header: Header, now: int) -> str:
        """Carry out a request. Returns the reason of a rejection with a text, or "" (8.2)."""
        who, echo = (header["source"], header["session"]), header.get("echo")
        mine = self.live(now) and self.holder == who
        if verb in ("stop", "disarm"):
            self.stopped = self.stopped or verb == "stop"
            self.disarm()
        elif not self.proven(header, now):
            return "NOT_PROVEN: another peer drives in this session"
        elif verb == "release":
            self.held_us = -LEASE_US if mine else self.held_us
        elif verb in ("arm", "reset", "acquire"):
            wrong = self.permit(verb, who, echo, now)
            if not wrong and who == self.holder:
                self.proof = header.get("proof"), header.get("next_proof")
            return wrong
        else:
            raise ValueError(verb)
        return ""

    def permit(self, verb: str, who: tuple[str, str], echo: Any, now: int) -> str:
        """Check a request that permits motion: it must cite a fresh status (8.3)."""
        if not isinstance(echo, dict):
            return "MALFORMED: cite a status"
        checks = {**self.young(echo, "status", now, STATUS_US), "STALE ": echo["seq"] > self.denied,
                  "NOT_HOLDER": verb != "acquire" or not self.live(now) or self.holder == who,
                  "STOPPED": verb != "arm" or not self.stopped,
                  "NOT_ALLOWED": verb != "arm" or self.armed or (self.live(now) and self.good >= 5)}
        wrong = next((reason.strip() for reason, holds in checks.items() if not holds), "")
        if wrong:
            return f"{wrong}: {verb} is not possible now"
        if verb == "acquire" and not (self.live(now) and self.holder == who):
            self.holder, self.held_us, self.good = who, now, 0
        self.stopped = self.stopped and verb != "reset"
        self.armed = self.armed or verb == "arm"
        return ""

    def wheels(self, now: int) -> tuple[float, float]:
        """Return linear and angular velocity for now: reduced for an older frame, zero after silence (5.3, 5.4)."""
        linear, angular, frame_us, came_us = self.command
        share = min(1.0, max(0.0, (MAX_AGE_US - (now - frame_us)) / (MAX_AGE_US - FULL_SPEED_US)))
        if not self.armed or now - came_us > SILENCE_US or share == 0.0:
            return 0.0, 0.0
        factor = min(1.0, share / max(abs(linear) / MAX_LINEAR_MPS, abs(angular) / MAX_ANGULAR_RAD_S, 1e-9))
        return linear * factor, angular * factor

    def status(self, now: int) -> Header:
        """Return the smallest valid status (clause 9)."""
        linear, angular = self.wheels(now)
        commanded = now - self.command[3] <= SILENCE_US
        state = "STOPPED" if self.stopped else "DISARMED" if not self.armed else "ACTIVE" if commanded else "HOLD"
        holder = {"source": self.holder[0], "digest": digest_of(*self.holder)} if self.live(now) else None
        refused = {reason: count for reason, count in self.refused.items() if reason and count}
        return {"state": state, "reason": "a minimal robot", "holder": holder, "applied": [linear, angular],
                "accepted": self.accepted, "refused": refused, "auto_arm": self.arms_itself,
                "max_linear_mps": MAX_LINEAR_MPS, "max_angular_rad_s": MAX_ANGULAR_RAD_S}
