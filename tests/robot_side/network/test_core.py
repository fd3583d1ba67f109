"""The network core: which frames, answers, encodings and models it passes on, with numbers."""

import pytest

from sightline.protocol.channels import ACK, CAMERA, FRAME
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import HardwareError, WireError
from sightline.protocol.messages import AnswerHeader, CameraModel, Echo, FrameHeader, Holder, Stamp, StreamStatus
from sightline.protocol.transports.link import Message
from sightline.robot_side.network.bitrate_control import EncodingTarget
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.network.stream import StreamConfig
from sightline.robot_side.pipe import CommandAck, RobotMotion
from sightline.robot_side.ports import Picture, scaled_model

ROBOT, VISION = "0000aaaa", "0000bbbb"
HOLDER = Holder(source="vision", session=VISION)
MODEL = CameraModel(width_px=320, height_px=240, fx_px=200.0, fy_px=200.0, cx_px=160.0, cy_px=120.0)
LATER_US = 60_000
"""After the interval of a frame at time 0, and before its credit times out."""


def core_of(seq=0, max_frame_bytes=400_000):
    return NetworkCore(StreamConfig(), ROBOT, seq, max_frame_bytes)


def core_with_a_frame_in_flight(seq=0):
    core = core_of(seq)
    assert core.on_camera(Picture(b"jpeg", 1), 1) is not None
    assert core.may_capture(LATER_US, True) is False, "no credit"
    return core


# --- images in, frames out ---------------------------------------------------------------------------------------


def test_each_image_leaves_once_with_its_number_and_its_capture_time():
    core = core_of(seq=41)
    frames = [core.on_camera(Picture(b"first", 0), 5), core.on_camera(Picture(b"second", 1), 6)]
    for (header, message), (seq, t_us, jpeg) in zip(frames, [(41, 0, b"first"), (42, 1, b"second")], strict=True):
        assert header == FrameHeader(session=ROBOT, seq=seq, t_us=t_us)
        assert message == Message(FRAME, "", encode(header), jpeg)
    assert core.on_camera(Picture(b"third", 2), 7)[0].seq == 43
    assert core.status(7).sent == 3 and core.status(7).refused_pictures == 0


def test_header_carries_the_motion_at_that_moment_to_a_tenth_of_a_millimeter():
    core = core_of()
    core.motion = RobotMotion((1.23456, -2.34567, 3.1415926), (0.12345, -0.23456), (0.34567, -0.45678), 84_000)
    header, _ = core.on_camera(Picture(b"", 1), 1)
    assert (header.pose, header.moving, header.applied, header.latency_us) == (
        (1.2346, -2.3457, 3.14159), (0.1235, -0.2346), (0.3457, -0.4568), 84_000
    )  # fmt: skip


@pytest.mark.parametrize(("t_us", "size_bytes", "leaves"), [
    (101, 1_000, True), (101, 1_001, False), (100, 1_000, False), (99, 1_000, False), (99, 1_001, False),
])  # fmt: skip
def test_image_that_is_too_large_or_not_newer_than_the_last_is_counted(t_us, size_bytes, leaves):
    core = core_of(max_frame_bytes=1_000)
    core.on_camera(Picture(b"", 100), 100)
    for count in (1, 2):
        sent = core.on_camera(Picture(b"x" * size_bytes, t_us), 200)
        assert core.status(200).refused_pictures == (1 if leaves and count == 2 else 0 if leaves else count)
        assert (sent is not None) == (leaves and count == 1)
    if not leaves:
        assert core.on_camera(Picture(b"x" * 1_000, 101), 300) is not None, "and moves no time"


def test_image_of_the_future_is_counted_and_named_and_the_stream_goes_on():
    """A camera whose clock steps gives such images."""
    core, now_us, sent = core_of(), 1_000_000, []
    for count in range(30):
        now_us += 33_333
        frame = core.on_camera(Picture(b"", now_us + 3_600_000_000 * (count == 9)), now_us)
        if frame is not None:
            core.on_command_ack(CommandAck(HOLDER, frame[0].seq, 0, HOLDER), now_us + 5_000)
        sent.append(frame is not None and core.may_capture(now_us + 33_333, True))
        fault = "image is 3600.000 s in the future" if count == 9 else ""
        assert core.status(now_us).camera_fault == fault
    assert sent == [True] * 9 + [False] + [True] * 20
    assert core.status(now_us).refused_pictures == 1


def test_time_that_a_camera_repeats_is_shown_once_no_frame_leaves():
    core = core_of()
    assert core.on_camera(Picture(b"", 1_000), 1_000) is not None
    assert core.on_camera(Picture(b"", 1_000), 2_000) is None
    fault = "the time of the image is not after that of the one before"
    assert core.image_fault == fault and core.status(1_001_000).camera_fault == ""
    assert core.status(1_001_001).camera_fault == fault and core.status(1_001_001).refused_pictures == 1
    assert core.on_camera(Picture(b"", 1_001), 1_002_000) is not None and core.image_fault == ""


@pytest.mark.parametrize(("t_us", "leaves"), [(1_000, True), (1_001, False)])
def test_image_that_was_captured_after_now_is_of_the_future(t_us, leaves):
    core = core_of()
    assert (core.on_camera(Picture(b"", t_us), 1_000) is not None) == leaves
    assert bool(core.status(1_000).camera_fault) != leaves
    assert core.status(1_000, camera_fault="unplugged").camera_fault == "unplugged", "it comes first"


def test_size_of_a_frame_and_the_times_of_both_clocks_reach_the_stream():
    core = core_of()
    core.on_camera(Picture(b"", 10_000), 25_000)
    assert core.status(1_025_000).fps == 1.0 and core.status(1_025_001).fps == 0.0, "sent at 25 ms"
    core.on_command_ack(CommandAck(HOLDER, 0, 0, HOLDER), 26_000)
    assert core.wait_us(26_000) == core.early_us(26_000) == 10_000 + 33_333 * 9 // 10 - 26_000, "due by its capture"
    assert core.may_capture(39_998, True) is False and core.may_capture(39_999, True) is True
    assert core.may_capture(39_999, False) is False, "no peer listens"


# --- answers -----------------------------------------------------------------------------------------------------


def ack(*, key="vision", source="vision", channel="frame", session=ROBOT, seq=0, t_us=1, compute_us=0):
    echo = Echo(channel=channel, session=session, seq=seq, t_us=t_us)
    header = AnswerHeader(source=source, session=VISION, seq=5, echo=echo, compute_us=compute_us)
    return Message(ACK, key, encode(header), b"")


@pytest.mark.parametrize(("key", "source"), [("viewer", "vision"), ("vision", "viewer")])
def test_ack_under_the_key_of_another_source_returns_no_credit(key, source):
    core = core_with_a_frame_in_flight()
    core.on_ack(ack(key=key, source=source), 20_000)
    assert not core.may_capture(LATER_US, True)
    core.on_ack(ack(), 30_000)
    assert core.may_capture(LATER_US, True)


@pytest.mark.parametrize(("changes", "returns"), [
    ({}, True), ({"session": "0000cccc"}, False), ({"seq": 6}, False), ({"seq": 8}, False), ({"seq": 9}, False),
    ({"channel": "status"}, False), ({"t_us": 0}, False), ({"t_us": 2}, False),
])  # fmt: skip
def test_ack_of_a_frame_of_this_session_returns_credit(changes, returns):
    core = core_with_a_frame_in_flight(seq=7)
    core.on_ack(ack(**{"seq": 7, **changes}), 20_000)
    assert core.may_capture(LATER_US, True) == returns
    assert (core._stream._owner == HOLDER) == returns


def test_newest_frames_are_those_that_an_ack_may_cite():
    core = core_of(seq=7)
    for count in range(300):
        core.on_camera(Picture(b"", count + 1), count + 1)
    assert core._frame_times == {7 + count: count + 1 for count in range(300 - 256, 300)}


def test_invalid_ack_raises_and_returns_no_credit():
    core = core_with_a_frame_in_flight()
    with pytest.raises(WireError):
        core.on_ack(Message(ACK, "vision", b"{}", b""), 20_000)
    assert not core.may_capture(LATER_US, True)


@pytest.mark.parametrize(("seq", "returns"), [(6, False), (7, True), (8, False)])
def test_validated_command_returns_the_credit_of_its_frame(seq, returns):
    core = core_with_a_frame_in_flight(seq=7)
    core.on_command_ack(CommandAck(HOLDER, seq, 0, None), 20_000)
    assert core.may_capture(LATER_US, True) == returns


def test_validated_command_passes_the_credit_to_the_holder_of_the_lease():
    """The credit that was in flight is returned, and the answers of others count no more."""
    core = core_with_a_frame_in_flight()
    viewer = Holder(source="viewer", session="0000cccc")
    core.on_command_ack(CommandAck(viewer, 0, 0, HOLDER), 20_000)
    assert core.may_capture(LATER_US, True)
    core.on_camera(Picture(b"", LATER_US), LATER_US)
    core.on_command_ack(CommandAck(viewer, 1, 0, HOLDER), LATER_US + 10_000)
    assert not core.may_capture(2 * LATER_US, True)
    core.on_command_ack(CommandAck(HOLDER, 1, 0, HOLDER), LATER_US + 20_000)
    assert core.may_capture(2 * LATER_US, True)


@pytest.mark.parametrize("answer", [
    lambda core, seq, now_us: core.on_ack(ack(seq=seq, t_us=now_us - 99_999, compute_us=99_000), now_us),
    lambda core, seq, now_us: core.on_command_ack(CommandAck(HOLDER, seq, 99_000, HOLDER), now_us),
])  # fmt: skip
def test_computing_time_of_a_peer_does_not_count_for_the_link(answer):
    """Answers after 100 ms: 99 ms of computing and 1 ms of the link, which needs no wider window."""
    core, now_us = core_of(), 0
    for seq in range(10):
        core.on_camera(Picture(b"", now_us + 1), now_us)
        now_us += 100_000
        answer(core, seq, now_us)
    assert core.status(now_us).window == 1


# --- the encoding ------------------------------------------------------------------------------------------------


class Encoder:
    """A camera that encodes its images. `follows` is what it answers, None stands for an unplugged one."""

    def __init__(self, follows=True):
        self.follows, self.requested = follows, []

    def adjust(self, quality_percent, scale_percent):
        if self.follows is None:
            raise HardwareError("unplugged")
        self.requested.append((quality_percent, scale_percent))
        return self.follows


def shown(core):
    status = core.status(0)
    return status.quality_percent, status.scale_percent


def test_encoding_target_is_passed_on_once_and_shown():
    core, camera = core_of(), Encoder()
    core.adapt(camera)
    assert camera.requested == [] and shown(core) == (100, 100), "as the camera begins"
    for target in ((80, 100), (80, 100), (60, 50)):
        core._stream._bitrate_control.target = EncodingTarget(*target)
        core.adapt(camera)
        assert shown(core) == target
    assert camera.requested == [(80, 100), (60, 50)]


def test_encoding_is_not_shown_where_the_camera_cannot_follow():
    core, camera = core_of(), Encoder(follows=False)
    core._stream._bitrate_control.target = EncodingTarget(80, 50)
    core.adapt(object())
    core.adapt(camera)
    core.adapt(camera)
    assert camera.requested == [(80, 50)] and shown(core) == (100, 100)


def test_encoding_is_requested_again_from_a_camera_that_was_gone():
    core, camera = core_of(), Encoder(follows=None)
    core._stream._bitrate_control.target = EncodingTarget(80, 50)
    core.adapt(camera)
    assert shown(core) == (100, 100)
    camera.follows = True
    core.adapt(camera)
    assert camera.requested == [(80, 50)] and shown(core) == (80, 50)


# --- the model of the camera -------------------------------------------------------------------------------------


def test_model_is_announced_at_once_and_then_each_half_second():
    core = core_of()
    announced = {now_us: core.announce_camera(MODEL, now_us) for now_us in (0, 499_999, 500_000, 999_999, 1_000_000)}
    assert [now_us for now_us, message in announced.items() if message] == [0, 500_000, 1_000_000]
    for seq, now_us in enumerate((0, 500_000, 1_000_000)):
        stamp = Stamp(session=ROBOT, seq=seq, t_us=now_us)
        assert announced[now_us] == Message(CAMERA, "", encode(stamp), encode(MODEL))


def test_model_of_a_later_process_of_the_session_has_higher_numbers():
    earlier, later = core_of(), core_of()
    messages = [earlier.announce_camera(MODEL, now_us) for now_us in range(0, 10_000_000, 500_000)]
    messages.append(later.announce_camera(MODEL, 10_000_000))
    seqs = [decode(Stamp, message.header).seq for message in messages]
    assert seqs == sorted(set(seqs))


def test_model_of_another_image_size_is_announced_before_its_first_frame():
    core = core_of()
    core.announce_camera(MODEL, 0)
    core.on_camera(Picture(b"", 1, scale_percent=50), 1)
    message = core.announce_camera(MODEL, 2)
    assert message is not None and decode(CameraModel, message.payload) == scaled_model(MODEL, 50)
    assert core.announce_camera(MODEL, 3) is None, "an equal model"
    core.on_camera(Picture(b"", 2), 4)
    assert decode(CameraModel, core.announce_camera(MODEL, 5).payload) == MODEL


def test_model_is_announced_again_for_a_driver_that_arrives_and_then_each_half_second():
    core = core_of()
    core.announce_camera(MODEL, 0)
    assert core.announce_camera(MODEL, 10) is None
    core.on_new_driver()
    assert core.announce_camera(MODEL, 0) is not None
    core.on_new_driver()
    assert core.announce_camera(MODEL, 20) is not None
    assert core.announce_camera(MODEL, 500_019) is None
    assert core.announce_camera(MODEL, 500_020) is not None


def test_driver_that_arrives_gets_a_frame_at_once():
    core = core_of()
    core.on_camera(Picture(b"", 1), 1)
    assert not core.may_capture(100_000, True), "the frame in flight has the only credit"
    core.on_new_driver()
    assert core.may_capture(100_000, True)


def test_same_model_is_found_without_a_comparison_of_its_fields():
    """The comparison takes longer than a frame may, for a model that is the same object 30 times a second."""

    class Model(CameraModel):
        def __eq__(self, other):
            raise AssertionError("compared")

        __hash__ = CameraModel.__hash__

    core, model = core_of(), Model(**MODEL.model_dump())
    assert core.announce_camera(model, 0) is not None
    assert core.announce_camera(model, 1) is None


# --- the status --------------------------------------------------------------------------------------------------


def test_status_shows_every_counter():
    core = core_of()
    for seq in range(3):
        core.on_camera(Picture(b"", seq + 1), seq + 1)
    core.on_ack(ack(seq=1, t_us=2), 10_000)
    assert core.may_capture(500_000, True), "the third has timed out"
    assert core.status(500_000) == StreamStatus(sent=3, fps=3.0, overtaken=1, credit_timeouts=1)
    shown = core.status(500_000, 4, {"status": 1, "scan": 0, "odometry": 5, "camera": 3}, 6)
    assert (shown.dropped_commands, shown.missed_captures) == (4, 6)
    assert list(shown.dropped.items()) == [("odometry", 5), ("camera", 3), ("status", 1)], "the most first"


@pytest.mark.parametrize("length", [0, 1, 200, 201])
def test_status_shows_what_fits_of_the_cause_without_images(length):
    assert core_of().status(0, camera_fault="x" * length).camera_fault == "x" * min(length, 200)
    assert core_of().status(0).camera_fault == ""


def test_status_shows_at_most_sixteen_channels():
    dropped = {f"channel{number}": number for number in range(1, 21)}
    assert sorted(core_of().status(0, dropped=dropped).dropped.values()) == list(range(5, 21))


@pytest.mark.parametrize("calibrated", [True, False])
def test_status_shows_whether_the_announced_model_was_measured(calibrated):
    core = core_of()
    assert core.status(0).calibrated is False
    core.announce_camera(MODEL.model_copy(update={"calibrated": calibrated}), 0)
    assert core.status(0).calibrated is calibrated
