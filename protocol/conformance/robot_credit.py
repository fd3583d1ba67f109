"""Cases on whose answers return credit, and on frames while nobody listens. Pure."""

from typing import Final

from sightline.protocol.channels import STATUS
from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.protocol.conformance.robot_flow import (
    OWNED_US,
    QUICK_FPS,
    SLOW_US,
    TAUGHT,
    again,
    fps_of,
    silent_fps,
    taught,
)
from sightline.conformance.robot.fixture import Robot, Sender
from sightline.protocol.messages import Status

SUITE: Final = Suite("R")
_ALONE_US: Final = 6_000_000
_AT_THE_EDGES: Final = 8
"""Frames that are sent before the robot knows that the kit has gone, or has come."""


@SUITE.must("R-FLOW-12", "7.2 Credit")
def malformed_returns_nothing(bench: Bench) -> None:
    """A twist that is MALFORMED returns no credit, though its header cites a frame."""
    watcher = taught(bench)
    silent = silent_fps(bench, watcher)
    bench.need(silent < QUICK_FPS, f"{silent:.0f} fps without any answer (R-FLOW-01)")
    forger = again(watcher)
    watcher.robot.each_frame(lambda frame: forger.twist(frame, b"x"))
    fps = fps_of(bench, 600_000)
    bench.expect(fps < 1.5 * silent, f"{fps:.0f} fps with twists that are MALFORMED, {silent:.0f} without")


@SUITE.must("R-FLOW-13", "7.3 Owner")
def credit_is_the_firsts(bench: Bench) -> None:
    """While nobody drives credit is the first's who answers: a second, quicker one does not hasten the frames."""
    first = Sender(Robot(bench))
    first.delay_us = first.compute_us = SLOW_US
    bench.need(bench.wait(lambda: first.ack_seq >= TAUGHT, 6_000_000), "too few frames")
    alone = fps_of(bench)
    Sender(first.robot, bench.access.watcher)
    beside = fps_of(bench)
    bench.need(alone <= 1.5e6 / SLOW_US, f"{alone:.0f} fps to a slow peer alone (R-FLOW-02)")
    bench.expect(beside <= 1.5 * alone, f"{alone:.0f} fps to a slow peer, {beside:.0f} beside a quick one")


@SUITE.must("R-FLOW-14", "7.3 Owner")
def credit_passes_on(bench: Bench) -> None:
    """Once the first has been silent for a second the answers of another return credit."""
    first = Sender(Robot(bench))
    bench.rest(OWNED_US)
    quick = fps_of(bench)
    bench.need(quick >= QUICK_FPS, f"only {quick:.0f} fps to a quick peer")
    first.fall_silent()
    bench.rest(OWNED_US)
    Sender(first.robot, bench.access.watcher)
    bench.rest(300_000)
    fps = fps_of(bench)
    bench.expect(fps >= 0.7 * quick, f"{quick:.0f} fps to the first, {fps:.0f} to the second")


@SUITE.must("R-FLOW-15", "7.1 Answers")
def seq_of_acks(bench: Bench) -> None:
    """The `seq` of an ack is not judged: acks that all have the same return credit."""
    watcher = Sender(Robot(bench))
    bench.rest(OWNED_US)
    quick = fps_of(bench)
    bench.need(quick >= QUICK_FPS, f"only {quick:.0f} fps to a quick peer")
    watcher.fall_silent()
    acking = again(watcher)
    acking.compute_us = 0
    watcher.robot.each_frame(lambda frame: acking.ack(frame, seq=7))
    fps = fps_of(bench)
    bench.expect(fps >= 0.7 * quick, f"{fps:.0f} fps with acks of one `seq`, {quick:.0f} with a rising one")


@SUITE.should("R-FLOW-16", "3.4 Rate")
def nobody_listens(bench: Bench) -> None:
    """While nobody listens no frame is captured: `stream.sent` stands still."""
    watcher = Sender(Robot(bench))
    watcher.robot.frame()
    watcher.fall_silent()
    before = watcher.robot.next_status(4).stream.sent
    bench.leave()
    bench.rest(_ALONE_US)
    mark = bench.mark()
    bench.join()
    bench.need(bench.wait(lambda: bench.heard(STATUS, mark), 5_000_000), "no status again (R-RECO-01)")
    first = bench.heard(STATUS, mark)[0].payload(Status)
    bench.need(first, "a status that cannot be read (R-FRAM-09)")
    assert first is not None
    grown = first.stream.sent - before
    bench.expect(grown <= _AT_THE_EDGES, f"{grown} frames were sent in {_ALONE_US / 1e6:g} s without a peer")
