"""Measure the time to encode a message, and to validate a command and its proof. Shell (a clock)."""

import secrets
import statistics
import time
from collections.abc import Callable
from statistics import median
from typing import Final

from sightline.evaluation.checks import Check, at_most
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader, Twist
from sightline.protocol.proof import MAX_LOST, ProofChain, continues
from sightline.protocol.text import format_twist, parse_twist
from sightline.robot_side.safety.gate import SafetyGate
from sightline.robot_side.safety.limits import TICK_US, SafetyConfig

CODEC_BOUND_US: Final = 10.0
_ROUNDS: Final = 200
_PER_ROUND: Final = 50

_FRAME = FrameHeader(
    session="0a1b2c3d",
    seq=123_456,
    t_us=987_654_321,
    pose=(1.2345, -0.4321, 0.5678),
    moving=(0.2012, -0.3498),
    applied=(0.2, -0.35),
    latency_us=52_000,
)
_ANSWER = AnswerHeader(
    source="vision",
    session="4e5f6071",
    seq=123_400,
    echo=Echo(channel="frame", session="0a1b2c3d", seq=123_456, t_us=987_654_321),
    compute_us=2_300,
)
_TWIST = Twist(linear_mps=0.2, angular_rad_s=-0.35)


def measure_codec() -> list[Check]:
    """Return medians over 200 rounds of 50 calls in a hot loop. After 33 ms of idling calls cost several times more."""
    took_us = {"frame header": _median_us(_frame), "answer header and twist": _median_us(_answer)}
    return [at_most(name, one_us, "us", CODEC_BOUND_US) for name, one_us in took_us.items()]


def _frame() -> None:
    decode(FrameHeader, encode(_FRAME))


def _answer() -> None:
    decode(AnswerHeader, encode(_ANSWER))
    parse_twist(format_twist(_TWIST))


def _median_us(call: Callable[[], object]) -> float:
    rounds = []
    for _ in range(_ROUNDS):
        begin_ns = time.perf_counter_ns()
        for _ in range(_PER_ROUND):
            call()
        rounds.append((time.perf_counter_ns() - begin_ns) / _PER_ROUND / 1000)
    return statistics.median(rounds)


# The time of the safety gate: one command validated, one step computed. Shell (reads the clock).


GATE_BOUND_US: Final = 20.0
_SESSION: Final = "0000aaaa"


def measure_gate(commands: int = 5_000) -> float:
    """Return the median of `offer` and `step` together while driving, us. Each command cites its own frame."""
    gate, took_us = SafetyGate(SafetyConfig(auto_arm=True), _SESSION), []
    twist = Twist(linear_mps=0.3, angular_rad_s=0.2)
    for number in range(commands):
        now_us = (number + 1) * TICK_US
        gate.issued.add("frame", number, now_us - 5_000)
        echo = Echo(channel="frame", session=_SESSION, seq=number, t_us=now_us - 5_000)
        header = AnswerHeader(source="vision", session="0000bbbb", seq=number, echo=echo)
        begin_ns = time.perf_counter_ns()
        gate.offer("vision", header, twist, now_us)
        gate.step(now_us)
        took_us.append((time.perf_counter_ns() - begin_ns) / 1000)
    if gate.accepted < commands - 10:
        raise RuntimeError(f"only {gate.accepted} of {commands} commands were accepted: {gate.counters}")
    return median(took_us)


PROOF_BOUND_US: Final = 100.0


def measure_proof() -> float:
    """Return the median time to check the proof of a command after the longest permitted run of lost ones, us."""
    chain = ProofChain(secrets.token_bytes)
    last, *_, newest = [chain.next() for _ in range(MAX_LOST + 1)]
    if not continues(newest.proof, last):
        raise RuntimeError(f"a proof after {MAX_LOST} hashes was rejected")
    return _median_us(lambda: continues(newest.proof, last))
