"""Quality and size, from the stream's wish to what vision makes of a picture whose size has changed."""

import math

import cv2
import numpy as np
import pytest

from sightline.protocol.channels import CAMERA
from sightline.protocol.codec import decode
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import MAX_CHANNELS_SHOWN, CameraModel, FrameHeader, StreamStatus
from sightline.robot_side.network.bitrate_control import EncodingTarget
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.network.stream import StreamConfig
from sightline.robot_side.ports import Picture, scaled_model, scaled_size
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.pipeline import Frame, Pipeline

MODEL = CameraModel(
    width_px=640, height_px=480, fx_px=381.0, fy_px=382.0, cx_px=322.0, cy_px=238.0, distortion=(0.1, -0.02, 0, 0, 0),
    z_m=0.2,
)
HALF = scaled_model(MODEL, 50)


class Eye:
    """A camera that records its encoding requests."""

    model, live = MODEL, True

    def __init__(self, follows=True):
        self.follows, self.asked, self.gone = follows, [], False

    def read(self, timeout_s):
        return None

    def close(self):
        pass

    def adjust(self, quality_percent, scale_percent):
        if self.gone:
            raise HardwareError("the camera is unplugged; plug it in")
        self.asked.append((quality_percent, scale_percent))
        return self.follows


class PlainEye:
    """A camera of an older plug-in."""

    model, live = MODEL, True

    def read(self, timeout_s):
        return None

    def close(self):
        pass


class Core(NetworkCore):
    """With the encoding target that a test sets."""

    def __init__(self):
        super().__init__(StreamConfig(), "0000aaaa", 0, 400_000)

    def follow(self, camera, *target):
        """Pass `target` on, and return the share of quality and of size that the status shows."""
        self._stream._bitrate_control.target = EncodingTarget(*target)
        self.adapt(camera)
        status = self.status(0)
        return status.quality_percent, status.scale_percent


def test_a_target_is_passed_on_once_per_change():
    eye, core = Eye(), Core()
    for target in ((100, 100), (80, 100), (80, 100), (80, 50), (100, 100)):
        assert core.follow(eye, *target) == target
    assert eye.asked == [(80, 100), (80, 50), (100, 100)]


def test_a_camera_that_was_gone_receives_the_target_again():
    eye, core = Eye(), Core()
    eye.gone = True
    assert core.follow(eye, 80, 100) == (100, 100)
    eye.gone = False
    assert core.follow(eye, 80, 100) == (80, 100)


@pytest.mark.parametrize("camera", [Eye(follows=False), PlainEye()])
def test_camera_with_its_own_jpegs_shows_full_quality(camera):
    assert Core().follow(camera, 30, 50) == (100, 100)


def test_drops_are_shown_by_channel_and_bounded():
    dropped = {f"channel{number:02}": number for number in range(40)}
    shown = Core().status(0, dropped=dropped, missed_captures=3)
    assert len(shown.dropped) == MAX_CHANNELS_SHOWN and shown.dropped["channel39"] == 39
    assert shown.missed_captures == 3
    assert StreamStatus.model_validate_json(shown.model_dump_json()) == shown


@pytest.mark.parametrize("scale_percent", [100, 75, 50, 33])
def test_a_scaled_model_sees_every_pixel_along_the_same_ray(scale_percent):
    scaled = scaled_model(MODEL, scale_percent)
    size = scaled_size(640, 480, scale_percent)
    assert (scaled.width_px, scaled.height_px) == (size.width_px, size.height_px)
    for share in (0.0, 0.25, 1.0):
        ray = (share * MODEL.width_px - MODEL.cx_px) / MODEL.fx_px
        assert (share * scaled.width_px - scaled.cx_px) / scaled.fx_px == pytest.approx(ray)
        ray = (share * MODEL.height_px - MODEL.cy_px) / MODEL.fy_px
        assert (share * scaled.height_px - scaled.cy_px) / scaled.fy_px == pytest.approx(ray)
    assert (scaled.distortion, scaled.z_m) == (MODEL.distortion, MODEL.z_m)


def test_a_new_model_is_announced_before_the_first_image_of_it():
    core = Core()
    core.on_camera(Picture(b"", 0), 0)
    first = core.announce_camera(MODEL, 0)
    assert first is not None and first.channel is CAMERA
    core.on_camera(Picture(b"", 2), 1_000)
    assert core.announce_camera(MODEL, 1_000) is None, "known, and not yet due"
    core.on_camera(Picture(b"", 3, scale_percent=50), 2_000)
    changed = core.announce_camera(MODEL, 2_000)
    assert changed is not None and decode(CameraModel, changed.payload) == HALF
    assert core.announce_camera(MODEL, 3_000) is None
    assert core.announce_camera(MODEL, 502_000) is not None, "twice a second"


@pytest.mark.parametrize("calibrated", [True, False])
def test_the_status_shows_whether_the_announced_model_was_measured(calibrated):
    core = Core()
    assert not core.status(0).calibrated
    core.announce_camera(MODEL.model_copy(update={"calibrated": calibrated}), 0)
    assert core.status(0).calibrated is calibrated


# --- vision ------------------------------------------------------------------------------------------------------


def ball(model, distance_m=1.0, radius_m=0.1):
    """A yellow ball straight ahead."""
    picture = np.full((model.height_px, model.width_px, 3), 120, np.uint8)
    across = round(model.fx_px * radius_m / math.sqrt(distance_m**2 - radius_m**2))
    cv2.circle(picture, (round(model.cx_px), round(model.cy_px)), across, (13, 199, 242), -1, cv2.LINE_AA)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def frame(seq, jpeg):
    return Frame(FrameHeader(session="0000aaaa", seq=seq, t_us=1_000_000 + seq * 33_333), jpeg)


def pipeline_of(model):
    return Pipeline(VisionConfig(), model.model_copy(update={"distortion": ()}), configured_detector(VisionConfig()))


@pytest.mark.parametrize(("known", "shown"), [(MODEL, HALF), (HALF, MODEL)])
def test_an_image_of_another_size_than_the_model_is_acknowledged_and_never_ranged(known, shown):
    pipeline = pipeline_of(known)
    for seq in range(5):
        pipeline.step(frame(seq, ball(known)))
    answer = pipeline.step(frame(5, ball(shown)))
    assert answer.twist is None and answer.seen.distance_m is None and answer.skipped == "MALFORMED"
    assert "camera model has" in answer.seen.note
    assert pipeline.step(frame(6, ball(known))).seen.distance_m is not None, "and nothing else is lost"


def test_the_same_ball_is_as_far_away_at_half_the_size():
    far_m = []
    for model in (MODEL, HALF):
        pipeline = pipeline_of(model)
        for seq in range(6):
            answer = pipeline.step(frame(seq, ball(model)))
        far_m.append(answer.seen.distance_m)
    assert far_m[0] == pytest.approx(far_m[1], rel=0.03)
