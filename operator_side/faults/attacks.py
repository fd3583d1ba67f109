"""Commands that must not move the wheels, and good ones that must not hurt: what a scripted driver sends. Shell."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Final

from sightline.operator_side.faults.driver import Script
from sightline.protocol.channels import ACK, MAX_HEADER_BYTES
from sightline.protocol.codec import encode
from sightline.protocol.messages import MAX_INTEGER, FrameHeader, Twist
from sightline.protocol.transports.zenoh_session import open_session

LATE_S: Final = 0.5
FLOOD_HZ: Final = 10_000
FLOOD_BATCH: Final = 50
FLOOD_S: Final = 3.0
REVERSE_S: Final = 0.02
HUGE_BYTES: Final = 10_000_000
MALFORMED: Final = (
    b"nan|0", b"0.5|nan", b"inf|0", b"-inf|0", b"1e400|0", b"1_0|0", "０.５|０".encode(), b"", b"|", b"0.5",
    b"0.5|0|0", b" 0.5|0", b"0.5|0\n", b"0.5,0", b"0x1p-1|0", b"\xff\xfe|\x00", bytes(range(32)),
)
OVERSIZED: Final = (b"0" * 63 + b"|0", b"0.5|" + b"0" * 253, b"0.5|" + b"0" * HUGE_BYTES)


def _frames(script: Script) -> Iterator[FrameHeader]:
    """Every new frame, for ever; while none comes (who sends nonsense gets few) the last again, 20 times a second."""
    last: FrameHeader | None = None
    while True:
        last = script.frame() or last
        if last is not None:
            yield last


def late(script: Script) -> None:
    """Each command half a second after its frame, or later where no newer frame is as old as that."""
    waiting: deque[FrameHeader] = deque(maxlen=64)
    while True:
        frame = script.frame()
        if frame is not None:
            waiting.append(frame)
        while len(waiting) > 1 and _is_late(waiting[1]):
            waiting.popleft()
        if waiting and _is_late(waiting[0]):
            script.attack(script.answer(waiting[0]))


def _is_late(frame: FrameHeader) -> bool:
    return time.monotonic() - frame.t_us / 1e6 > LATE_S


def replay(script: Script) -> None:
    """What was sent before, again and again: this session's, or a recording of an earlier one."""
    recording = script.options.recording
    earlier = [tuple(map(bytes.fromhex, line.split())) for line in recording.open()] if recording else script.sent
    messages = list(earlier)
    while True:
        for header, text in messages[-50:]:
            script.attack(header, text)
            time.sleep(0.005)


def never_issued(script: Script) -> None:
    """Frames that the robot never sent."""
    for frame in _frames(script):
        script.attack(script.answer(frame, seq=frame.seq + 1000))


def from_future(script: Script) -> None:
    """The frame's own number with a time to come, and the next frame before it is issued."""
    for frame in _frames(script):
        script.attack(script.answer(frame, t_us=frame.t_us + 1_000_000))
        script.attack(script.answer(frame, seq=frame.seq + 1, t_us=frame.t_us + 33_333))


def wrapped(script: Script) -> None:
    """The highest number of all, then from zero again."""
    frames = _frames(script)
    script.seq = MAX_INTEGER - 1
    script.drive(next(frames))
    script.seq = -1
    for frame in frames:
        script.attack(script.answer(frame))


def malformed(script: Script) -> None:
    """Every text that is no twist, with a header that would do."""
    with open_session((), [script.options.endpoint], 5.0) as stranger:
        for frame in _frames(script):
            for text in MALFORMED:
                script.attack(script.answer(frame), text)
            for text in OVERSIZED:  # the link would refuse to send these
                script.injected()
                stranger.put(script.key, text, attachment=encode(script.answer(frame)))
            script.attack(b"{" * MAX_HEADER_BYTES)
            time.sleep(0.1)


def flood(script: Script) -> None:
    """One old command at 10 kHz."""
    header, text = script.sent[0]
    started_s, batches = time.monotonic(), 0
    while time.monotonic() - started_s < FLOOD_S:
        for _ in range(FLOOD_BATCH):
            script.attack(header, text)
        batches += 1
        time.sleep(max(0.0, started_s + batches * FLOOD_BATCH / FLOOD_HZ - time.monotonic()))


def reversal(script: Script) -> None:
    """Full speed ahead and back at 50 Hz, citing properly; then silence."""
    end_s, sign = time.monotonic() + 2.0, 1.0
    frame = next(_frames(script))
    while time.monotonic() < end_s:
        frame, sign = script.frame(0.0) or frame, -sign
        script.drive(frame, Twist(linear_mps=0.5 * sign, angular_rad_s=0.0))
        script.injected()
        time.sleep(REVERSE_S)


def heartbeat(script: Script) -> None:
    """Acknowledges every frame, stays connected, commands nothing."""
    for frame in _frames(script):
        script.injected()
        script.link.publish(ACK, encode(script.answer(frame)), b"", script.options.source)


def thousand(script: Script) -> None:
    """A thousand good commands, quickly, then on as before."""
    frame = next(_frames(script))
    for _ in range(1000):
        frame = script.frame(0.0) or frame
        script.attack(script.answer(frame))
        time.sleep(0.001)
    for frame in _frames(script):
        script.attack(script.answer(frame))


ATTACKS: Final[dict[str, Callable[[Script], None]]] = {
    attack.__name__: attack
    for attack in (late, replay, never_issued, from_future, wrapped, malformed, flood, reversal, heartbeat, thousand)
}
