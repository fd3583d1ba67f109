"""A thin, far, lossy or broken link in virtual time, with TCP's habits, for the stream: nothing here waits."""

import heapq
import math
from dataclasses import dataclass, field
from itertools import pairwise
from random import Random

from sightline.protocol.messages import Holder
from sightline.robot_side.network.stream import Stream, StreamConfig

VISION = Holder(source="vision", session="0000bbbb")
PACKET_BYTES = 1360
FRAME_US = 33_333
MAX_AGE_US = 400_000
TAIL = 3
"""Of so many last packets a loss is noticed by a probe only, after two round trips."""


@dataclass
class Leg:
    """One direction: packets leave one after the other, arrive in order, and what is lost is sent again."""

    delay_us: int
    rate_bit_s: float = 0.0
    loss: float = 0.0
    burst: tuple[float, float] = (0.0, 1.0)
    """Chances per packet that a burst of losses begins, and that it ends."""
    steps: tuple[tuple[int, float], ...] = ()
    """(from when, rate)."""
    down_us: tuple[int, int] = (0, 0)
    queue_bytes: int = 300_000
    gone: float = 0.0
    """Share of whole messages that never arrive, as without TCP."""
    gone_in_a_row: float = 1.0
    """Mean number of those in a row."""
    seed: int = 1
    free_us: float = 0.0
    arrived_us: float = 0.0
    in_burst: bool = False
    losing: bool = False
    random: Random = field(init=False)

    def __post_init__(self):
        self.random = Random(self.seed)

    def rate(self, now_us):
        if not self.steps:  # called once per packet, millions of times
            return self.rate_bit_s
        return next((rate for since, rate in reversed(self.steps) if now_us >= since), self.rate_bit_s)

    def send(self, size_bytes, now_us):
        """When the last byte arrives; None if the sender's buffer was full and it was dropped whole."""
        rate = self.rate(now_us)
        if rate and (self.free_us - now_us) * rate / 8e6 > self.queue_bytes:
            return None
        packets = max(1, -(-size_bytes // PACKET_BYTES))
        at_us = max(float(now_us), self.free_us)
        if not (rate or self.steps or self.loss or self.burst[0] or self.in_burst):
            at_us = self.after_outage(at_us)
            self.arrived_us = max(self.arrived_us, at_us + self.delay_us)
            self.random.getrandbits(2 * 64 * packets)  # what `recovery_us` draws, so that the same messages are gone
            packets = 0  # they all arrive then
        for number in range(packets):
            at_us = self.after_outage(at_us)
            rate = self.rate(at_us)
            at_us += PACKET_BYTES * 8e6 / rate if rate else 0.0
            self.arrived_us = max(self.arrived_us, at_us + self.delay_us + self.recovery_us(packets - number))
        self.free_us = at_us
        return None if self.gone and self.is_gone() else self.arrived_us

    def is_gone(self):
        """Gilbert's model, as in `MemoryNetwork`."""
        if self.gone_in_a_row == 1:
            return self.random.random() < self.gone
        enter = self.gone / (self.gone_in_a_row * (1 - self.gone))
        self.losing = self.random.random() < (1 - 1 / self.gone_in_a_row if self.losing else enter)
        return self.losing

    def after_outage(self, at_us):
        """Sent into a dead link: again and again, twice as late each time, until one try falls behind the outage."""
        begin, end = self.down_us
        if not begin <= at_us < end:
            return at_us
        wait = 200_000.0
        while at_us < end:
            at_us += wait
            wait = min(2 * wait, 1_000_000)  # by then the link is open again
        return at_us

    def recovery_us(self, left):
        chance = self.burst[1] if self.in_burst else self.burst[0]
        if self.random.random() < chance:
            self.in_burst = not self.in_burst
        if not self.in_burst and self.random.random() >= self.loss:
            return 0.0
        return (2 if left > TAIL else 4) * self.delay_us + 10_000


@dataclass
class Camera:
    """Weighs a picture as JPEG encoders do, roughly."""

    full_bytes: int = 46_000
    adjustable: bool = True
    seed: int = 1

    def __post_init__(self):
        self.random = Random(self.seed)

    def bytes_at(self, wish):
        quality, scale = (share / 100 for share in wish) if self.adjustable else (1.0, 1.0)
        return round(self.full_bytes * scale**2 * (0.12 + 0.88 * quality**1.3) * self.random.uniform(0.95, 1.05))


@dataclass
class Course:
    """The result: answers (at, age, bytes), and the stream."""

    answers: list
    stream: Stream
    windows: list
    captures: int

    def ages_ms(self, since_s=2.0, until_s=1e9):
        return sorted(age / 1000 for at, age, _ in self.answers if since_s <= at / 1e6 < until_s)

    def p(self, percent, since_s=2.0, until_s=1e9):
        ages = self.ages_ms(since_s, until_s)
        return ages[min(len(ages) - 1, len(ages) * percent // 100)]

    def fps(self, since_s, until_s):
        return len([1 for at, age, _ in self.answers if since_s <= at / 1e6 < until_s and age <= MAX_AGE_US]) / (
            until_s - since_s)

    def bytes(self, since_s, until_s):
        sizes = [size for at, _, size in self.answers if since_s <= at / 1e6 < until_s]
        return sum(sizes) / max(1, len(sizes))

    def gaps_ms(self, since_s=2.0):
        """Between commands young enough to be driven on; before the first and after the last one too."""
        times = [at / 1000 for at, age, _ in self.answers if at >= since_s * 1e6 and age <= MAX_AGE_US]
        end_ms = len(self.windows)  # one for each millisecond
        return [after - before for before, after in pairwise([since_s * 1000, *times, end_ms])]

    def longest_gap_ms(self, since_s=2.0):
        return max(self.gaps_ms(since_s))


def run(out, back, *, seconds=20.0, compute_us=3_000, camera=None, config=None, slot_us=500, copies=1):
    """A camera that ticks, the stream, `out` and `back`, and a peer that looks at the newest frame.

    The peer sends each answer `copies` times.
    """
    camera, stream = camera or Camera(), Stream(config or StreamConfig())
    events, answers, windows = [], [], []
    state = {"seq": 0, "slot": None, "busy": 0.0, "captures": 0}

    def push(at_us, kind, item):
        heapq.heappush(events, (at_us, len(answers) + state["seq"] * 10, kind, item))

    def look(now):
        if state["slot"] and now >= state["busy"]:
            item, state["slot"] = state["slot"], None
            state["busy"] = now + compute_us
            for at in [back.send(100, round(now + compute_us)) for _ in range(copies)]:
                if at is not None:
                    push(at + slot_us, "answer", item)
            push(state["busy"], "look", None)

    ticks, tick = round(seconds * 1e6 / 1000), 0
    while tick < ticks:
        now = tick * 1000
        while events and events[0][0] <= now:
            at, _, kind, item = heapq.heappop(events)
            if kind == "arrive":
                state["slot"] = item
            elif kind == "answer":
                seq, t_us, size = item
                stream.on_answer(VISION, seq, compute_us, round(at))
                answers.append((at, at - t_us, size))
            look(at)
        if now % FRAME_US < 1000 and stream.may_capture(now, listening=True):
            state["captures"] += 1
            size = camera.bytes_at(stream.encoding_target)
            stream.on_sent(state["seq"], now, now, size)
            at = out.send(size, now)
            if at is not None:
                push(at, "arrive", (state["seq"], now, size))
            state["seq"] += 1
        # Nothing changes until the next message or picture.
        next_us = min((now // FRAME_US + 1) * FRAME_US, events[0][0] if events else math.inf)
        after = min(ticks, max(tick + 1, math.ceil(next_us / 1000)))
        windows += [stream.window] * (after - tick)
        tick = after
    return Course(answers, stream, windows, state["captures"])
