"""Cases on credit: when a robot may send a frame, and whose answers let it. Pure.

How long credit stays out depends on how quick its owner was before. So most cases answer slowly for a while, saying
that they compute (which widens no window), and then look at what comes while they do not answer.
"""

from itertools import pairwise
from typing import Final

from sightline.protocol.channels import FRAME, STATUS
from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.robot.fixture import Robot, Sender
from sightline.protocol.messages import Stamp

SUITE: Final = Suite("R")
SLOW_US: Final = 90_000
"""A slow detector: some frames at 30 fps."""
_LATE_US: Final = 180_000
"""So late that a picture which waited for the answer is told from one taken after it."""
OWNED_US: Final = 1_600_000
"""Credit is its owner's for a second after the last answer: also that of who answered in the case before."""
TAUGHT: Final = 14
"""Answers after which a robot expects slow ones."""
_OF_QUICK: Final = 0.8
"""A share of the full rate that no credit leaves to the silent, and no credit at all exceeds."""
QUICK_FPS: Final = 15
"""Below this, camera and credit cannot be told apart."""


def taught(bench: Bench, answers: int = TAUGHT) -> Sender:
    """A watcher that has answered slowly for a while and now answers nothing; its last answer was to the last frame."""
    watcher = Sender(Robot(bench))
    watcher.delay_us = watcher.compute_us = SLOW_US
    bench.need(bench.wait(lambda: watcher.ack_seq >= answers, 6_000_000), "too few frames")
    watcher.fall_silent()
    return watcher


def _gaps_us(bench: Bench, since: int) -> list[int]:
    times = [one.at_us for one in bench.heard(FRAME, since)]
    return [then - was for was, then in pairwise(times)]


def fps_of(bench: Bench, for_us: int = 1_000_000) -> float:
    mark = bench.mark()
    bench.rest(for_us)
    return len(bench.heard(FRAME, mark)) * 1e6 / for_us


def silent_fps(bench: Bench, watcher: Sender) -> float:
    """How many frames a second come to somebody who has been slow and answers no more."""
    watcher.fall_silent()
    return fps_of(bench, 600_000)


def _rates(bench: Bench) -> tuple[Sender, float, float]:
    """A watcher that answered quickly, then slowly, then not at all: it, and frames a second at first and at last."""
    watcher = Sender(Robot(bench))
    bench.rest(OWNED_US)
    quick = fps_of(bench)
    bench.need(quick >= QUICK_FPS, f"only {quick:.0f} fps to a quick peer")
    watcher.delay_us = watcher.compute_us = SLOW_US
    bench.rest(1_300_000)
    watcher.fall_silent()
    return watcher, quick, fps_of(bench)


@SUITE.must("R-FLOW-01", "7.5 Timeout")
def no_credit_no_frame(bench: Bench) -> None:
    """To a peer that has fallen silent frames come only as credit times out."""
    _watcher, quick, silent = _rates(bench)
    bench.expect(silent <= _OF_QUICK * quick, f"{silent:.0f} fps to a silent peer, {quick:.0f} to one that answers")


@SUITE.must("R-FLOW-02", "7.4 Window")
def slow_detector_widens_nothing(bench: Bench) -> None:
    """However slow a detector, one frame is in flight: computing does not widen the window."""
    watcher, quick, silent = _rates(bench)
    bench.need(silent <= _OF_QUICK * quick, "frames come without credit (R-FLOW-01)")
    watcher.acks = True
    bench.rest(2_000_000)
    fps = fps_of(bench, 1_500_000)
    bench.expect(fps <= 1.25e6 / SLOW_US, f"{fps:.0f} fps to a peer that computes {SLOW_US // 1000} ms for each")


@SUITE.must("R-FLOW-03", "7.2 Credit")
def acks_return_credit(bench: Bench) -> None:
    """An ack returns credit as a twist does: the frame rate is the same."""
    sender = Sender(Robot(bench))
    sender.drive()
    bench.rest(OWNED_US)
    by_twists = fps_of(bench)
    bench.need(by_twists >= QUICK_FPS, f"only {by_twists:.0f} fps with twists")
    sender.drive(None)
    by_acks = fps_of(bench)
    bench.expect(by_acks >= 0.7 * by_twists, f"{by_acks:.0f} fps with acks, {by_twists:.0f} with twists")


@SUITE.must("R-FLOW-04", "7.2 Credit")
def refused_twists_return_credit(bench: Bench) -> None:
    """A refused twist that cites a frame returns its credit."""
    watcher = Sender(Robot(bench))
    watcher.need_good()
    by_acks = fps_of(bench)
    bench.need(by_acks >= QUICK_FPS, f"only {by_acks:.0f} fps with acks")
    refused = Sender(watcher.robot, acks=False)
    refused.session = watcher.session
    watcher.fall_silent()
    refused.twist(watcher.robot.frame(), seq=10_000)
    watcher.robot.each_frame(lambda frame: refused.twist(frame, seq=5))
    fps = fps_of(bench)
    bench.expect(fps >= 0.7 * by_acks, f"{fps:.0f} fps with twists that are OUT_OF_ORDER, {by_acks:.0f} with acks")


@SUITE.must("R-FLOW-05", "7.5 Timeout")
def lost_credit_times_out(bench: Bench) -> None:
    """Credit that is not returned times out: frames go on within 500 ms."""
    taught(bench)
    mark = bench.mark()
    bench.rest(2_500_000)
    gaps_us = _gaps_us(bench, mark)
    bench.expect(len(gaps_us) >= 2, "without an answer no frames came any more")
    bench.expect(max(gaps_us) <= 650_000, f"without an answer {max(gaps_us) / 1e3:.0f} ms passed between two frames")


@SUITE.must("R-FLOW-06", "7.3 Owner")
def credit_is_the_drivers(bench: Bench) -> None:
    """Acks of others do not return the credit of who drives: frames come at the driver's pace."""
    robot = Robot(bench)
    driver = Sender(robot)
    driver.delay_us = driver.compute_us = SLOW_US
    driver.drive()
    bench.need(bench.wait(lambda: driver.seq >= TAUGHT, 6_000_000), "too few frames")
    alone = fps_of(bench)
    Sender(robot, bench.access.watcher)
    beside = fps_of(bench)
    bench.need(alone <= 1.5e6 / SLOW_US, f"{alone:.0f} fps to a slow driver alone (R-FLOW-02)")
    bench.expect(beside <= 1.5 * alone, f"{alone:.0f} fps to a slow driver, {beside:.0f} beside a quick watcher")


@SUITE.should("R-FLOW-07", "7.4 Window")
def long_link_widens(bench: Bench) -> None:
    """On a link that takes 100 ms, more than one frame is in flight."""
    watcher = Sender(Robot(bench))
    bench.rest(OWNED_US)
    quick = fps_of(bench)
    bench.need(quick >= QUICK_FPS, f"only {quick:.0f} fps to a quick peer")
    watcher.delay_us = 110_000
    bench.rest(2_500_000)
    fps = fps_of(bench)
    bench.expect(fps >= 1.5e6 / 110_000, f"{fps:.0f} fps over 110 ms, {quick:.0f} without delay")


@SUITE.must("R-FLOW-08", "7.2 Credit")
def answers_count_for_older(bench: Bench) -> None:
    """An answer returns the credit of its frame and of all older ones."""
    watcher = Sender(Robot(bench))
    watcher.delay_us = 300_000
    bench.rest(5_000_000)
    fps = fps_of(bench)
    bench.need(fps >= 9, f"{fps:.0f} fps over 300 ms: the window is not wide (R-FLOW-07)")
    watcher.fall_silent()
    full = bench.wait(lambda: _silent_for(bench, 50_000), 400_000)
    bench.need(full, "frames come without credit (R-FLOW-01)")
    mark = bench.mark()
    watcher.ack(watcher.robot.frames()[-1][1])
    bench.rest(100_000)
    came = len(bench.heard(FRAME, mark))
    bench.expect(came >= 2, f"{came} frames within 100 ms of an answer to the newest of many in flight")


def _silent_for(bench: Bench, for_us: int) -> bool:
    newest = bench.newest(FRAME)
    return newest is None or bench.now_us - newest.at_us >= for_us


@SUITE.must("R-FLOW-09", "7.2 Credit")
def other_session_returns_nothing(bench: Bench) -> None:
    """An ack that cites another session of the robot returns no credit."""
    watcher = taught(bench)
    silent = silent_fps(bench, watcher)
    bench.need(silent < QUICK_FPS, f"{silent:.0f} fps without any answer (R-FLOW-01)")
    forger = again(watcher)
    watcher.robot.each_frame(lambda frame: forger.ack(frame, echo_session="fffffff0"))
    fps = fps_of(bench, 600_000)
    bench.expect(fps < 1.5 * silent, f"{fps:.0f} fps with acks for another session, {silent:.0f} without")


@SUITE.must("R-FLOW-10", "7.2 Credit")
def unknown_frame_returns_nothing(bench: Bench) -> None:
    """An ack that cites a frame not yet sent returns no credit."""
    watcher = taught(bench)
    silent = silent_fps(bench, watcher)
    bench.need(silent < QUICK_FPS, f"{silent:.0f} fps without any answer (R-FLOW-01)")
    forger = again(watcher)
    watcher.robot.each_frame(lambda frame: forger.ack(frame, echo_seq=frame.seq + 1000))
    fps = fps_of(bench, 600_000)
    bench.expect(fps < 1.5 * silent, f"{fps:.0f} fps with acks for frames to come, {silent:.0f} without")


def again(watcher: Sender) -> Sender:
    """The same peer, answering by hand."""
    again = Sender(watcher.robot, acks=False)
    again.session, again.ack_seq = watcher.session, watcher.ack_seq
    again.compute_us = SLOW_US
    return again


@SUITE.must("R-FLOW-11", "7.2 Credit")
def never_stored(bench: Bench) -> None:
    """A frame is sent at its capture: one that waited for credit is not sent later."""
    robot = Robot(bench)
    watcher = Sender(robot)
    watcher.delay_us = watcher.compute_us = _LATE_US
    bench.rest(3_000_000)
    stamps = [(one, one.header(Stamp)) for one in bench.heard(STATUS)]
    clock_us = min((one.at_us - stamp.t_us for one, stamp in stamps if stamp), default=0)
    delays_us = sorted(one.at_us - header.t_us - clock_us for one, header in robot.frames())
    bench.need(len(delays_us) >= 8, "too few frames")
    median_us = delays_us[len(delays_us) // 2]
    bench.expect(median_us <= _LATE_US // 2, f"half of the frames are {median_us / 1e3:.0f} ms old when they leave")
