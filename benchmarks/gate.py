"""What the safety gate costs: one command judged and one step decided. Shell (reads the clock)."""

import time
from statistics import median
from typing import Final

from sightline.protocol.messages import AnswerHeader, Echo, Twist
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.robot_side.safety.gate import SafetyGate

GATE_BOUND_US: Final = 20.0
_SESSION: Final = "0000aaaa"
_TICK_US: Final = 20_000


def measure_gate(commands: int = 5_000) -> float:
    """Median microseconds of `offer` and `step` together, driving: each command cites a frame of its own."""
    gate, took_us = SafetyGate(SafetyConfig(auto_arm=True), _SESSION), []
    twist = Twist(linear_mps=0.3, angular_rad_s=0.2)
    for number in range(commands):
        now_us = (number + 1) * _TICK_US
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
