"""Cases on published messages and on credit: frames, status, odometry, rates. Pure."""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import pairwise
from statistics import median
from typing import Final

from sightline.conformance.case import Bench, Received, Suite
from sightline.conformance.robot.fixture import FAST_LINK_US, Robot, Sender, armed, ready, vision
from sightline.protocol.channels import (
    CAMERA,
    CHANNELS,
    FRAME,
    KEY_PREFIX,
    MAX_HEADER_BYTES,
    ODOMETRY,
    SCAN,
    STATUS,
    Channel,
    Direction,
)
from sightline.protocol.codec import decode_ranges
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import CameraModel, FrameHeader, Odometry, ScanHeader, Stamp, State, Status, WireModel
from sightline.protocol.transports.link import INEXACT_KEY, OVERSIZE

SUITE: Final = Suite("R")
_WATCHED_US: Final = 2_000_000
_SLACK: Final = 0.7  # of a stated rate: cost of a loaded machine and of a link that drops messages
_MAX_OVERHEAD_BYTES: Final = 320
_CLOCKS_APART_US: Final = 500_000
"""Longer than a message takes on a slow link."""
FROM_ROBOT: Final = tuple(one for one in CHANNELS.values() if one.direction is Direction.FROM_ROBOT)


def watched(bench: Bench) -> Robot:
    """Return a robot whose frames were all acknowledged for two seconds."""
    robot = Robot(bench)
    Sender(robot)
    bench.rest(_WATCHED_US)
    return robot


def _all_frames(robot: Robot, good: Callable[[Received], object], what: str) -> None:
    bench = robot.bench
    frames = bench.received(FRAME)
    bench.expect(frames, "no frame came within 2 s, though frames were wanted and acknowledged")
    bad = [one for one in frames if not good(one)]
    if bad:
        bench.expect(False, f"{len(bad)} of {len(frames)} frames: {what}; first {bad[0].message.header[:120]!r}")


def _is_jpeg(one: Received) -> bool:
    try:
        read_jpeg_size(one.message.payload)
    except WireError:
        return False
    return one.message.payload.rstrip(b"\0")[-2:] == b"\xff\xd9"


def _replied(bench: Bench) -> Robot:
    """Return a watched robot that also answered three requests, so that something came on each of its channels."""
    robot = watched(bench)
    for _ in range(3):
        Sender(robot, "operator", acks=False).request("disarm")
    return robot


@SUITE.must("R-FRAM-03", "2.5 Session and sequence", _replied)
def one_session(bench: Bench, _robot: Robot) -> None:
    """All channels carry the same session for as long as the robot runs."""
    sessions: dict[str, set[str]] = {}
    for channel in FROM_ROBOT:
        stamps = [one.header(Stamp) for one in bench.received(channel)]
        sessions[channel.name] = {stamp.session for stamp in stamps if stamp}
    everything = set().union(*sessions.values())
    bench.expect(len(everything) == 1, f"sessions by channel: {sessions}")


@SUITE.should("R-FRAM-04", "1.4 Sizes")
def small_overhead(bench: Bench) -> None:
    """Header and key of a frame take at most 320 bytes."""
    key_bytes = len(f"{KEY_PREFIX}/{bench.robot}/{FRAME.name}")
    most = _MAX_OVERHEAD_BYTES - key_bytes
    _all_frames(watched(bench), lambda one: len(one.message.header) <= most, f"over {_MAX_OVERHEAD_BYTES} bytes")


@SUITE.must("R-FRAM-05", "1.4 Sizes")
def sizes_within_bounds(bench: Bench) -> None:
    """No header is over 512 bytes and no payload over its channel's bound."""
    before = bench.dropped_here[OVERSIZE]
    watched(bench)
    over = bench.dropped_here[OVERSIZE] - before
    bench.expect(not over, f"{over} messages were over their bound (header {MAX_HEADER_BYTES} bytes)")


@SUITE.must("R-FRAM-06", "1.3 Keys")
def exact_keys(bench: Bench) -> None:
    """The robot publishes under the exact keys of the table, never under a wildcard."""
    before = bench.dropped_here[INEXACT_KEY]
    watched(bench)
    other = bench.dropped_here[INEXACT_KEY] - before
    bench.expect(not other, f"{other} messages came under another key than their channel's")


@SUITE.must("R-FRAM-08", "10.1 Camera, odometry, scan", watched)
def camera_model_is_of_the_picture(bench: Bench, robot: Robot) -> None:
    """The camera model's width and height are those of the encoded image."""
    model, frames = robot.camera(), [one for one in bench.received(FRAME) if _is_jpeg(one)]
    bench.need(model is not None and frames, "no camera model or no image to compare")
    assert model is not None
    size = read_jpeg_size(frames[-1].message.payload)
    bench.expect(
        (size.width_px, size.height_px) == (model.width_px, model.height_px),
        f"the image is {size.width_px}x{size.height_px}, the model {model.width_px}x{model.height_px}",
    )


@SUITE.should("R-FRAM-10", "10.2 Camera, odometry, scan", watched)
def odometry_rate(bench: Bench, _robot: Robot) -> None:
    """Odometry, where the robot has it, comes at 20 Hz and can be read."""
    bench.need(bench.received(ODOMETRY), "this robot publishes no odometry")
    _rate(bench, ODOMETRY, Odometry, 20)


def _rate(bench: Bench, channel: Channel, model: type[WireModel], rate_hz: int) -> None:
    name, received = channel.name, bench.received(channel)
    unread = [one for one in received if one.header(Stamp) is None or one.payload(model) is None]
    bench.expect(not unread, f"{len(unread)} of {len(received)} `{name}` cannot be read")
    least = int(_SLACK * rate_hz * _WATCHED_US / 1e6)
    bench.expect(len(received) >= least, f"{len(received)} `{name}` in 2 s, at least {least} belong to {rate_hz} Hz")


@SUITE.must("R-FRAM-11", "10.3 Camera, odometry, scan", watched)
def scans_can_be_read(bench: Bench, _robot: Robot) -> None:
    """A scan, where the robot has them, has a ScanHeader and whole, non-negative float32 ranges."""
    scans = bench.received(SCAN)
    bench.need(scans, "this robot publishes no scans")
    for one in scans:
        bench.expect(one.header(ScanHeader), f"no ScanHeader: {one.message.header[:120]!r}")
        try:
            decode_ranges(one.message.payload)
        except WireError as error:
            bench.expect(False, f"ranges: {error.detail}")


@SUITE.must("R-FRAM-12", "2.8 Fields", armed)
def applied_in_frames(bench: Bench, driver: Sender) -> None:
    """While the robot drives, `applied` in the frames is what was last given to the wheels."""
    moves = driver.robot.reaches(lambda status: status.applied[0] > 0.05, 1_500_000)
    bench.need(moves, "the robot does not drive (R-LIM-01)")
    bench.rest(300_000)
    mark = bench.mark()
    bench.rest(300_000)
    reported = [header.applied[0] for _, header in driver.robot.frames(mark)]
    bench.need(reported, "no frame while driving")
    reason = f"status reports {driver.robot.status().applied}, the frames {reported[-1]}"
    driver.robot.expect_at_speed(max(reported) > 0.05, reason)


@SUITE.must("R-FRAM-13", "2.8 Fields", armed)
def latency_in_frames(bench: Bench, driver: Sender) -> None:
    """`latency_us` of a frame, where it is given, is the time from capture to the acceptance of the last command."""
    reported: list[int] = []
    bench.need(driver.robot.link_us() <= _SHORT_US, "over this link, answers after 120 ms come too late")
    for delay_us in (20_000, 120_000):
        driver.delay_us = driver.compute_us = delay_us
        bench.rest(1_000_000)
        latency_us = driver.robot.frame().latency_us
        bench.need(latency_us is not None, "its frames give no latency")
        reported.append(latency_us or 0)
    follows = reported[0] + 50_000 <= reported[1] <= 400_000
    bench.expect(follows, f"answers after 20 and 120 ms are reported to take {reported} us")


def _grows(robot: Robot, channel: Channel, what: str, values: Iterable[int], least_step: int = 1) -> None:
    """Fail the case unless `values` grow by `least_step` each."""
    falls = (f"{was} is followed by {then}" for was, then in pairwise(values) if then - was < least_step)
    fall = next(falls, "")
    robot.bench.expect(not fall, f"{channel.name}: {what} {fall}")


def _stamps(robot: Robot, channel: Channel) -> list[Stamp]:
    return [stamp for one in robot.bench.received(channel) if (stamp := one.header(Stamp)) is not None]


def _counts_up(robot: Robot, channel: Channel) -> None:
    _grows(robot, channel, "seq", [stamp.seq for stamp in _stamps(robot, channel)])


def _times_grow(robot: Robot, channel: Channel, least_step: int) -> None:
    _grows(robot, channel, "t_us", [stamp.t_us for stamp in _stamps(robot, channel)], least_step)


def _status_counts(robot: Robot) -> None:
    _counts_up(robot, STATUS)
    _times_grow(robot, STATUS, 0)


SUITE.must_all(watched, {
    "R-FRAM-01": ("2.8 Fields", "Every frame has a header with all required fields of FrameHeader, in their bounds.",
                  lambda it: _all_frames(it, lambda one: one.header(FrameHeader), "no FrameHeader")),
    "R-FRAM-02": ("3.1 Payload", "The payload of every frame is a baseline or progressive JPEG of at most 1920 x "
                  "1080 pixels and nothing else.", lambda it: _all_frames(it, _is_jpeg, "no JPEG within bounds")),
    "R-FRAM-07": ("10.1 Camera, odometry, scan", "The camera model is published twice a second and can be read.",
                  lambda it: _rate(it.bench, CAMERA, CameraModel, 2)),
    "R-FRAM-09": ("9. Status", "`status` is published at 10 Hz and can be read.",
                  lambda it: _rate(it.bench, STATUS, Status, 10)),
    "R-SEQ-01": ("2.5 Session and sequence", "`seq` of the frames counts up by at least one.",
                 lambda it: _counts_up(it, FRAME)),
    "R-SEQ-02": ("2.6 Clock", "`t_us` of the frames, the time of capture, always grows.",
                 lambda it: _times_grow(it, FRAME, 1)),
    "R-SEQ-03": ("2.6 Clock", "`seq` of `status` counts up and its `t_us` never goes back.", _status_counts),
})


# --- sequence --------------------------------------------------------------------------------------------------------


@SUITE.must("R-SEQ-04", "2.5 Session and sequence", _replied)
def each_channel_counts(_bench: Bench, robot: Robot) -> None:
    """Every other channel has a `seq` of its own that counts up."""
    for channel in FROM_ROBOT:
        if channel not in (FRAME, STATUS):
            _counts_up(robot, channel)


@SUITE.must("R-SEQ-05", "2.6 Clock", _replied)
def one_clock(bench: Bench, _robot: Robot) -> None:
    """All channels are stamped by one clock: a frame or scan at its capture, everything else as it is published."""
    stamps = {channel.name: [(one.at_us, stamp.t_us) for one in bench.received(channel) if (stamp := one.header(Stamp))]
              for channel in FROM_ROBOT}
    bench.need(stamps[FRAME.name] and stamps[STATUS.name], "frames or status are missing")
    behind_us = min(at_us - t_us for at_us, t_us in stamps[STATUS.name])
    for name, pairs in stamps.items():
        apart_us = median(at_us - t_us for at_us, t_us in pairs) - behind_us if pairs else 0
        bench.expect(abs(apart_us) <= _CLOCKS_APART_US, f"`t_us` of {name} is {apart_us / 1e6:.1f} s behind status")


# Cases on credit: when a robot may send a frame, and whose answers return credit. Pure.
#
# The timeout of credit depends on how fast its owner answered before. Most cases therefore answer slowly for a time and
# report it as compute time, which widens no window. Then they stop answering and count the frames.


SLOW_US: Final = 90_000
"""A slow detector: some frames at 30 fps."""
_LATE_US: Final = 180_000
"""Delay at which an image that waited for the answer differs from one taken after it."""
_SHORT_US: Final = 200_000
"""Delay of a link at which a robot accepts answers after 120 ms."""
_LONG_US: Final = 110_000
"""Delay of a link, and of the kit's answers in addition, at which more than one frame is in flight."""
OWNED_US: Final = 1_600_000
"""A peer owns the credit for a second after its last answer; so does the peer of the last case."""
TAUGHT: Final = 14
"""Answers after which a robot expects slow ones."""
_OF_QUICK: Final = 0.8
"""Share of the full frame rate: below it for a silent peer with credit, above it for a robot without credit."""
_LEASE_LASTS_US: Final = 700_000
"""Within the second of a lease. Afterwards a twist with another proof takes it."""
_COUNTED_US: Final = 600_000
"""Within the second in which a peer owns the credit."""
QUICK_FPS: Final = 15
"""Below this, camera and credit cannot be distinguished."""


def taught(bench: Bench, answers: int = TAUGHT) -> Sender:
    """Return a watcher that answered slowly and does not answer now. Its last answer was to the last frame."""
    watcher = Sender(Robot(bench))
    watcher.delay_us = watcher.compute_us = SLOW_US
    bench.need(bench.wait(lambda: watcher.ack_seq >= answers, 6_000_000), "too few frames")
    watcher.fall_silent()
    return watcher


def _quick_fps(bench: Bench, what: str = "to a quick peer") -> float:
    """Return the frames per second, which must exceed those of the camera alone."""
    fps = fps_of(bench)
    bench.need(fps >= QUICK_FPS, f"only {fps:.0f} fps {what}")
    return fps


def _gaps_us(bench: Bench, since: int) -> list[int]:
    times = [one.at_us for one in bench.received(FRAME, since)]
    return [then - was for was, then in pairwise(times)]


def fps_of(bench: Bench, for_us: int = 1_000_000) -> float:
    mark = bench.mark()
    bench.rest(for_us)
    return len(bench.received(FRAME, mark)) * 1e6 / for_us


def _rates(bench: Bench) -> tuple[Sender, float, float]:
    """Return a watcher that answered fast, then slowly, then not at all, and the first and last frame rate."""
    watcher = Sender(Robot(bench))
    bench.rest(OWNED_US)
    quick = _quick_fps(bench)
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


# On a fast link credit times out almost as soon as it is answered, so both cases answer slowly. A timeout is then at
# least half as long again as an answer. The median of the gaps is compared: one stall of a machine must not count.
_LONGER: Final = 1.4


def _gap_us(bench: Bench, what: str) -> int:
    """Return the median time between two frames for two seconds, to a slow peer that answers."""
    mark = bench.mark()
    bench.rest(2_000_000)
    gaps_us = sorted(_gaps_us(bench, mark))
    bench.need(gaps_us, f"hardly any frames in 2 s {what} that come after {SLOW_US // 1000} ms")
    return gaps_us[len(gaps_us) // 2]


@SUITE.must("R-FLOW-03", "7.2 Credit", vision)
def acks_return_credit(bench: Bench, sender: Sender) -> None:
    """An ack returns credit as a twist does: the frame rate is the same."""
    sender.delay_us = sender.compute_us = SLOW_US
    sender.drive()
    bench.rest(2 * OWNED_US)
    by_twists = _gap_us(bench, "with twists")
    sender.drive(None)
    by_acks = _gap_us(bench, "with acks")
    reported = f"a frame each {by_acks / 1e3:.0f} ms with acks, {by_twists / 1e3:.0f} ms with twists"
    bench.expect(by_acks <= _LONGER * by_twists, reported)


@SUITE.must("R-FLOW-04", "7.2 Credit", ready)
def rejected_twists_return_credit(bench: Bench, watcher: Sender) -> None:
    """A rejected twist that cites a frame returns its credit."""
    watcher.delay_us = watcher.compute_us = SLOW_US
    bench.rest(2 * OWNED_US)
    by_acks = _gap_us(bench, "with acks")
    rejected = Sender(watcher.robot, acks=False)
    rejected.session, rejected.proofs, rejected.compute_us = watcher.session, watcher.proofs, SLOW_US
    watcher.fall_silent()
    frame = watcher.robot.frame()
    bench.rest(SLOW_US)
    rejected.twist(frame, seq=10_000)
    watcher.robot.each_frame(lambda frame: bench.after(SLOW_US, partial(rejected.twist, frame, seq=5)))
    by_twists = _gap_us(bench, "with rejected twists")
    reported = f"a frame each {by_twists / 1e3:.0f} ms with OUT_OF_ORDER twists, {by_acks / 1e3:.0f} ms with acks"
    steady = by_twists <= _LONGER * by_acks or watcher.robot.link_us() < _LONG_US - FAST_LINK_US
    bench.need(steady, f"{reported}: over this link, the window is not steady")
    bench.expect(by_twists <= _LONGER * by_acks, reported)


@SUITE.must("R-FLOW-05", "7.5 Timeout")
def lost_credit_times_out(bench: Bench) -> None:
    """Credit that is not returned times out: frames go on within 500 ms."""
    mark = bench.mark()
    taught(bench)
    usual_us, mark = median(_gaps_us(bench, mark)), bench.mark()
    bench.rest(2_500_000)
    gaps_us = _gaps_us(bench, mark)
    bench.expect(len(gaps_us) >= 2, "without an answer no frames came any more")
    # A slow camera delivers its next image up to an interval after the timeout.
    most_us = max(650_000, 550_000 + usual_us)
    bench.expect(max(gaps_us) <= most_us, f"without an answer {max(gaps_us) / 1e3:.0f} ms passed between two frames")


@SUITE.must("R-FLOW-06", "7.3 Owner", Robot)
def credit_is_the_drivers(bench: Bench, robot: Robot) -> None:
    """Acks of others do not return the credit of the driver: frames come at the driver's pace."""
    driver = Sender(robot)
    driver.delay_us = driver.compute_us = SLOW_US
    driver.drive()
    bench.need(bench.wait(lambda: driver.seq >= TAUGHT, 6_000_000), "too few frames")
    _second_hastens_nothing(driver)


@SUITE.should("R-FLOW-07", "7.4 Window", vision)
def long_link_widens(bench: Bench, watcher: Sender) -> None:
    """On a link that takes 100 ms, more than one frame is in flight."""
    bench.rest(OWNED_US)
    quick = _quick_fps(bench)
    watcher.delay_us = max(0, _LONG_US - watcher.robot.link_us())
    bench.rest(2_500_000)
    fps, long_us = fps_of(bench), max(_LONG_US, watcher.robot.link_us())
    bench.expect(fps >= 1.5e6 / long_us, f"{fps:.0f} fps over {long_us // 1000} ms, {quick:.0f} without delay")


@SUITE.must("R-FLOW-08", "7.2 Credit", vision)
def answers_count_for_older(bench: Bench, watcher: Sender) -> None:
    """An answer returns the credit of its frame and of all older ones."""
    bench.rest(OWNED_US)
    interval_us = round(1e6 / _quick_fps(bench))
    watcher.delay_us = 300_000 - min(300_000, watcher.robot.link_us())
    bench.rest(5_000_000)
    fps = fps_of(bench)
    bench.need(fps >= 9, f"{fps:.0f} fps over 300 ms: the window is not wide (R-FLOW-07)")
    watcher.fall_silent()
    full = bench.wait(lambda: _silent_for(bench, max(50_000, interval_us * 5 // 4)), 400_000)
    bench.need(full, "frames come without credit (R-FLOW-01)")
    mark = bench.mark()
    watcher.ack(watcher.robot.frames()[-1][1])
    bench.wait(lambda: bench.received(FRAME, mark), 160_000)  # over a slow link; lost credit is back later
    within_us = max(100_000, interval_us * 5 // 2)
    bench.rest(within_us)
    came = len(bench.received(FRAME, mark))
    reported = f"{came} frames within {within_us / 1e3:.0f} ms of an answer to the newest of many in flight"
    bench.expect(came >= 2, reported)


def _silent_for(bench: Bench, for_us: int) -> bool:
    newest = bench.newest(FRAME)
    return newest is None or bench.now_us - newest.at_us >= for_us


def again(watcher: Sender) -> Sender:
    """Return the same peer, which answers by hand."""
    again = Sender(watcher.robot, acks=False)
    again.session, again.proofs, again.ack_seq = watcher.session, watcher.proofs, watcher.ack_seq
    again.compute_us = SLOW_US
    return again


@SUITE.must("R-FLOW-11", "7.2 Credit", Robot)
def never_stored(bench: Bench, robot: Robot) -> None:
    """A frame is sent at its capture: one that waited for credit is not sent later."""
    watcher = Sender(robot)
    watcher.delay_us = watcher.compute_us = _LATE_US
    bench.rest(3_000_000)
    stamps = [(one, one.header(Stamp)) for one in bench.received(STATUS)]
    clock_us = min((one.at_us - stamp.t_us for one, stamp in stamps if stamp), default=0)
    delays_us = sorted(one.at_us - header.t_us - clock_us for one, header in robot.frames())
    bench.need(len(delays_us) >= 8, "too few frames")
    median_us = delays_us[len(delays_us) // 2]
    bench.expect(median_us <= _LATE_US // 2, f"half of the frames are {median_us / 1e3:.0f} ms old when they leave")


# Cases on whose answers return credit, and on frames while no client listens. Pure.


def _second_hastens_nothing(first: Sender) -> None:
    """Fail the case if a fast second peer makes frames come faster than the slow `first` answers."""
    bench = first.bench
    alone = fps_of(bench)
    Sender(first.robot, bench.access.watcher)
    beside = fps_of(bench)
    bench.need(alone <= 1.5e6 / SLOW_US, f"{alone:.0f} fps to a slow peer alone (R-FLOW-02)")
    bench.expect(beside <= 1.5 * alone, f"{alone:.0f} fps to a slow peer, {beside:.0f} next to a quick one")


def _returns_nothing(watcher: Sender, what: str, forge: Callable[[Sender, FrameHeader], None]) -> None:
    """Fail the case if a message by `forge` about each frame returns credit to a slow peer."""
    bench = watcher.bench
    silent = fps_of(bench, _COUNTED_US)
    bench.need(silent < QUICK_FPS, f"{silent:.0f} fps without any answer (R-FLOW-01)")
    forger = again(watcher)
    watcher.robot.each_frame(partial(forge, forger))
    fps = fps_of(bench, _COUNTED_US)
    most = max(1.5 * silent, silent + 2e6 / _COUNTED_US)  # a difference of one frame is chance
    bench.expect(fps < most, f"{fps:.0f} fps with {what}, {silent:.0f} without")


def _ack_as_another(by: Sender, frame: FrameHeader) -> None:
    """Acknowledge `frame` with the header of `vision` under the key of `teleop`."""
    by.source = "teleop"
    by.ack(frame, source="vision")


SUITE.must_all(taught, {
    "R-FLOW-09": ("7.2 Credit", "An ack that cites another session of the robot returns no credit.",
                  lambda it: _returns_nothing(it, "acks for another session",
                                              lambda by, frame: by.ack(frame, echo_session="fffffff0"))),
    "R-FLOW-10": ("7.2 Credit", "An ack that cites a frame not yet sent returns no credit.",
                  lambda it: _returns_nothing(it, "acks for frames to come",
                                              lambda by, frame: by.ack(frame, echo_seq=frame.seq + 1000))),
    "R-FLOW-18": ("7.2 Credit", "An ack that cites a frame with a `t_us` off by one returns no credit.",
                  lambda it: _returns_nothing(it, "acks with another `t_us`",
                                              lambda by, frame: by.ack(frame, echo_t_us=frame.t_us + 1))),
    "R-FLOW-19": ("7.2 Credit", "An ack whose header names another source than its key returns no credit.",
                  lambda it: _returns_nothing(it, "acks under the key of another source", _ack_as_another)),
    "R-FLOW-12": ("7.2 Credit", "A twist that is MALFORMED returns no credit, though its header cites a frame.",
                  lambda it: _returns_nothing(it, "twists that are MALFORMED",
                                              lambda by, frame: by.twist(frame, b"x"))),
})


@SUITE.must("R-FLOW-17", "7.2 Credit", vision)
def not_proven_returns_nothing(bench: Bench, driver: Sender) -> None:
    """A twist that is NOT_PROVEN returns no credit, though its header cites a frame."""
    driver.drive()
    bench.rest(OWNED_US)
    quick = _quick_fps(bench)
    driver.delay_us = driver.compute_us = SLOW_US
    bench.rest(1_300_000)
    driver.fall_silent()
    forger, before = again(driver), driver.robot.status().refused.get("NOT_PROVEN", 0)
    driver.robot.each_frame(lambda frame: forger.twist(frame, proof="ab" * 16))
    fps = fps_of(bench, _LEASE_LASTS_US)
    bench.need(driver.robot.counts("NOT_PROVEN", before), "another proof is not NOT_PROVEN (R-PROOF-01)")
    bench.expect(fps <= _OF_QUICK * quick, f"{fps:.0f} fps with twists that are NOT_PROVEN, {quick:.0f} with good ones")


@SUITE.must("R-FLOW-20", "7.2 Credit", vision)
def stopped_twists_return_credit(bench: Bench, driver: Sender) -> None:
    """A twist that is rejected as STOPPED returns credit."""
    bench.rest(OWNED_US)
    quick = _quick_fps(bench)
    Sender(driver.robot, "operator", acks=False).send_request("stop")
    bench.need(driver.robot.becomes(State.STOPPED), "STOP does not stop this robot (R-STOP-01)")
    driver.drive()
    bench.rest(300_000)
    fps = fps_of(bench)
    bench.expect(fps >= 0.7 * quick, f"{fps:.0f} fps with twists rejected as STOPPED, {quick:.0f} with acks")


_ALONE_US: Final = 6_000_000
_AT_THE_EDGES: Final = 8
"""Frames sent before the robot detects that the kit has disconnected or connected."""


@SUITE.must("R-FLOW-13", "7.3 Owner", vision)
def credit_is_the_firsts(bench: Bench, first: Sender) -> None:
    """While no source drives, the first peer that answers owns the credit: a quicker one does not hasten the frames."""
    first.delay_us = first.compute_us = SLOW_US
    bench.need(bench.wait(lambda: first.ack_seq >= TAUGHT, 6_000_000), "too few frames")
    _second_hastens_nothing(first)


@SUITE.must("R-FLOW-14", "7.3 Owner", vision)
def credit_passes_on(bench: Bench, first: Sender) -> None:
    """Once the first has been silent for a second the answers of another return credit."""
    bench.rest(OWNED_US)
    quick = _quick_fps(bench)
    first.fall_silent()
    bench.rest(OWNED_US)
    Sender(first.robot, bench.access.watcher)
    bench.rest(OWNED_US)
    fps = fps_of(bench)
    bench.expect(fps >= 0.7 * quick, f"{quick:.0f} fps to the first, {fps:.0f} to the second")


@SUITE.must("R-FLOW-15", "7.1 Answers", vision)
def seq_of_acks(bench: Bench, watcher: Sender) -> None:
    """The `seq` of an ack is not validated: acks that all have the same return credit."""
    bench.rest(OWNED_US)
    quick = _quick_fps(bench)
    watcher.fall_silent()
    acking = again(watcher)
    acking.compute_us = 0
    watcher.robot.each_frame(lambda frame: acking.ack(frame, seq=7))
    fps = fps_of(bench)
    bench.expect(fps >= 0.7 * quick, f"{fps:.0f} fps with acks of one `seq`, {quick:.0f} with a rising one")


@SUITE.should("R-FLOW-16", "3.4 Rate", vision)
def no_client_listens(bench: Bench, watcher: Sender) -> None:
    """While no client listens no frame is captured: `stream.sent` stands still."""
    watcher.robot.frame()
    watcher.fall_silent()
    before = watcher.robot.next_status(4).stream.sent
    bench.leave()
    bench.rest(_ALONE_US)
    mark = bench.mark()
    bench.join()
    bench.need(bench.wait(lambda: bench.received(STATUS, mark), 5_000_000), "no status again (R-RECO-01)")
    first = bench.received(STATUS, mark)[0].payload(Status)
    bench.need(first, "a status that cannot be read (R-FRAM-09)")
    assert first is not None
    grown = first.stream.sent - before
    bench.expect(grown <= _AT_THE_EDGES, f"{grown} frames were sent in {_ALONE_US / 1e6:g} s without a peer")
