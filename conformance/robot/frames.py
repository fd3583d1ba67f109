"""Cases on what a robot publishes: frames, their headers, camera model, status and odometry, at their rates. Pure."""

from collections.abc import Callable
from itertools import pairwise
from typing import Final

from sightline.protocol.channels import (
    CAMERA,
    CHANNELS,
    FRAME,
    KEY_PREFIX,
    MAX_HEADER_BYTES,
    ODOMETRY,
    SCAN,
    STATUS,
    Direction,
)
from sightline.protocol.codec import decode_ranges
from sightline.protocol.conformance.bench import Bench, Heard
from sightline.conformance.case import Suite
from sightline.conformance.robot.fixture import Robot, Sender, armed
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import CameraModel, FrameHeader, Odometry, ScanHeader, Stamp, Status
from sightline.protocol.transports.link_rules import INEXACT_KEY, OVERSIZE

SUITE: Final = Suite("R")
_WATCHED_US: Final = 2_000_000
_SLACK: Final = 0.7  # of a stated rate: a loaded machine and a link that drops may cost so much
_MAX_OVERHEAD_BYTES: Final = 320


def watched(bench: Bench) -> Robot:
    """A robot whose frames were all acknowledged for two seconds."""
    robot = Robot(bench)
    Sender(robot)
    bench.rest(_WATCHED_US)
    return robot


def _all_frames(bench: Bench, good: Callable[[Heard], object], what: str) -> None:
    watched(bench)
    frames = bench.heard(FRAME)
    bench.expect(frames, "no frame came within 2 s, though frames were wanted and acknowledged")
    bad = [one for one in frames if not good(one)]
    if bad:
        bench.expect(False, f"{len(bad)} of {len(frames)} frames: {what}; first {bad[0].message.header[:120]!r}")


@SUITE.must("R-FRAM-01", "2.8 Fields")
def frame_headers_can_be_read(bench: Bench) -> None:
    """Every frame has a header with all that FrameHeader demands, in its bounds."""
    _all_frames(bench, lambda one: one.header(FrameHeader), "no FrameHeader")


@SUITE.must("R-FRAM-02", "3.1 Payload")
def payload_is_a_jpeg(bench: Bench) -> None:
    """The payload of every frame is a baseline or progressive JPEG of at most 1920 x 1080 pixels and nothing else."""
    _all_frames(bench, _is_jpeg, "no JPEG within bounds")


def _is_jpeg(one: Heard) -> bool:
    try:
        read_jpeg_size(one.message.payload)
    except WireError:
        return False
    return one.message.payload.rstrip(b"\0")[-2:] == b"\xff\xd9"


@SUITE.must("R-FRAM-03", "2.5 Session and sequence")
def one_session(bench: Bench) -> None:
    """All channels carry the same session for as long as the robot runs."""
    watched(bench)
    sessions: dict[str, set[str]] = {}
    for channel in (FRAME, STATUS, CAMERA, ODOMETRY):
        stamps = [one.header(Stamp) for one in bench.heard(channel)]
        sessions[channel.name] = {stamp.session for stamp in stamps if stamp}
    everything = set().union(*sessions.values())
    bench.expect(len(everything) == 1, f"sessions by channel: {sessions}")


@SUITE.should("R-FRAM-04", "1.4 Sizes")
def small_overhead(bench: Bench) -> None:
    """What is around a frame's JPEG (header and key) takes at most 320 bytes."""
    key_bytes = len(f"{KEY_PREFIX}/{bench.robot}/{FRAME.name}")
    most = _MAX_OVERHEAD_BYTES - key_bytes
    _all_frames(bench, lambda one: len(one.message.header) <= most, f"over {_MAX_OVERHEAD_BYTES} bytes")


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


@SUITE.must("R-FRAM-07", "10.1 Camera, odometry, scan")
def camera_model(bench: Bench) -> None:
    """The camera model is published twice a second and can be read."""
    watched(bench)
    _rate(bench, CAMERA.name, CameraModel, 2)


@SUITE.must("R-FRAM-08", "10.1 Camera, odometry, scan")
def camera_model_is_of_the_picture(bench: Bench) -> None:
    """The camera model's width and height are those of the encoded picture."""
    robot = watched(bench)
    model, frames = robot.camera(), [one for one in bench.heard(FRAME) if _is_jpeg(one)]
    bench.need(model is not None and frames, "no camera model or no picture to compare")
    assert model is not None
    size = read_jpeg_size(frames[-1].message.payload)
    bench.expect(
        (size.width_px, size.height_px) == (model.width_px, model.height_px),
        f"the picture is {size.width_px}x{size.height_px}, the model {model.width_px}x{model.height_px}",
    )


@SUITE.must("R-FRAM-09", "9. Status")
def status_rate(bench: Bench) -> None:
    """`status` is published at 10 Hz and can be read."""
    watched(bench)
    _rate(bench, STATUS.name, Status, 10)


@SUITE.should("R-FRAM-10", "10.2 Camera, odometry, scan")
def odometry_rate(bench: Bench) -> None:
    """Odometry, where the robot has it, comes at 20 Hz and can be read."""
    watched(bench)
    bench.need(bench.heard(ODOMETRY), "this robot publishes no odometry")
    _rate(bench, ODOMETRY.name, Odometry, 20)


def _rate(bench: Bench, name: str, model: type[CameraModel] | type[Status] | type[Odometry], rate_hz: int) -> None:
    heard = bench.heard(CHANNELS[name])
    unread = [one for one in heard if one.header(Stamp) is None or one.payload(model) is None]
    bench.expect(not unread, f"{len(unread)} of {len(heard)} `{name}` cannot be read")
    least = int(_SLACK * rate_hz * _WATCHED_US / 1e6)
    bench.expect(len(heard) >= least, f"{len(heard)} `{name}` in 2 s, at least {least} belong to {rate_hz} Hz")


@SUITE.must("R-FRAM-11", "10.3 Camera, odometry, scan")
def scans_can_be_read(bench: Bench) -> None:
    """A scan, where the robot has them, has a ScanHeader and whole, non-negative float32 ranges."""
    watched(bench)
    scans = bench.heard(SCAN)
    bench.need(scans, "this robot publishes no scans")
    for one in scans:
        bench.expect(one.header(ScanHeader), f"no ScanHeader: {one.message.header[:120]!r}")
        try:
            decode_ranges(one.message.payload)
        except WireError as error:
            bench.expect(False, f"ranges: {error.detail}")


@SUITE.must("R-FRAM-12", "2.8 Fields")
def applied_in_frames(bench: Bench) -> None:
    """While the robot drives, `applied` in the frames is what was last given to the wheels."""
    robot, _driver = armed(bench)
    bench.need(robot.reaches(lambda status: status.applied[0] > 0.05, 1_500_000), "the robot does not drive (R-LIM-01)")
    bench.rest(300_000)
    mark = bench.mark()
    bench.rest(300_000)
    told = [header.applied[0] for _, header in robot.frames(mark)]
    bench.need(told, "no frame while driving")
    bench.expect(max(told) > 0.05, f"status says {robot.status().applied}, the frames {told[-1]}")


# --- sequence --------------------------------------------------------------------------------------------------------


def _stamps(bench: Bench, name: str) -> list[Stamp]:
    return [stamp for one in bench.heard(CHANNELS[name]) if (stamp := one.header(Stamp)) is not None]


def _falls(values: list[int], least_step: int) -> str:
    falls = (f"{was} is followed by {then}" for was, then in pairwise(values) if then - was < least_step)
    return next(falls, "")


@SUITE.must("R-SEQ-01", "2.5 Session and sequence")
def frame_seq_counts_up(bench: Bench) -> None:
    """`seq` of the frames counts up by at least one."""
    watched(bench)
    fall = _falls([stamp.seq for stamp in _stamps(bench, FRAME.name)], 1)
    bench.expect(not fall, f"seq {fall}")


@SUITE.must("R-SEQ-02", "2.6 Clock")
def frame_time_goes_forward(bench: Bench) -> None:
    """`t_us` of the frames, the time of capture, always grows."""
    watched(bench)
    fall = _falls([stamp.t_us for stamp in _stamps(bench, FRAME.name)], 1)
    bench.expect(not fall, f"t_us {fall}")


@SUITE.must("R-SEQ-03", "2.6 Clock")
def status_seq_and_time(bench: Bench) -> None:
    """`seq` of `status` counts up and its `t_us` never goes back."""
    watched(bench)
    stamps = _stamps(bench, STATUS.name)
    fall = _falls([stamp.seq for stamp in stamps], 1) or _falls([stamp.t_us for stamp in stamps], 0)
    bench.expect(not fall, fall)


@SUITE.must("R-SEQ-04", "2.5 Session and sequence")
def each_channel_counts(bench: Bench) -> None:
    """Every other channel has a `seq` of its own that counts up."""
    watched(bench)
    rest = [one.name for one in CHANNELS.values() if one.direction is Direction.FROM_ROBOT]
    for name in set(rest) - {FRAME.name, STATUS.name}:
        fall = _falls([stamp.seq for stamp in _stamps(bench, name)], 1)
        bench.expect(not fall, f"{name}: seq {fall}")


@SUITE.must("R-SEQ-05", "2.6 Clock")
def one_clock(bench: Bench) -> None:
    """All channels are stamped by one clock: a frame is captured before the status that follows it is published."""
    robot = watched(bench)
    offsets = {name: [] for name in (FRAME.name, STATUS.name)}  # type: dict[str, list[int]]
    for channel in (FRAME, STATUS):
        for one in bench.heard(channel):
            stamp = one.header(Stamp)
            if stamp is not None:
                offsets[channel.name].append(one.at_us - stamp.t_us)
    bench.need(all(offsets.values()), "frames or status are missing")
    apart_us = abs(min(offsets[FRAME.name]) - min(offsets[STATUS.name]))
    bench.expect(apart_us <= 500_000, f"frames and status of {robot.bench.robot} are {apart_us / 1e6:.1f} s apart")
