"""The stand-in of a legacy robot over a link in memory: STOP, disarm, arm, the assumed camera, the target's box."""

import numpy as np
import pytest

from sightline.operator_side.client.status import next_step
from sightline.operator_side.config.loading import load_service
from sightline.protocol.channels import DETECTIONS, FRAME, REPLY, REQUEST, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import (
    DetectedBox,
    Detections,
    Echo,
    FrameHeader,
    Reply,
    Request,
    RequestHeader,
    Stamp,
    Status,
    Verb,
)
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.serving.legacy_robot import LegacyRobotLink, assumed_camera, camera_line, target_box
from sightline.vision_side.serving.service import Service, open_service
from tests.fixtures.vision.vision import camera, jpeg_of, scene

DRIVE = b"0.2000|-0.3500"
ZERO = b"0.0000|0.0000"
LEGACY = VisionConfig(connect=("ws-legacy://127.0.0.1:9091",), detector=DetectorConfig(kind="hsv"))


class Bench:
    """The vision service's link, with an operator and the robot on the other end."""

    def __init__(self) -> None:
        self.network = MemoryNetwork(seed=1)
        self.far = self.network.link("r1")
        self.operator = self.network.link("r1", role="operator")
        self.twists, self.boxes = self.far.latest(TWIST), self.far.latest(DETECTIONS)
        self.replies, self.statuses = self.operator.latest(REPLY), self.operator.latest(STATUS)
        self.link = LegacyRobotLink(self.network.link("r1", role="vision"), lambda: self.network.now_us)

    def advance(self) -> None:
        self.network.advance(self.network.now_us + 10_000)

    def drive(self) -> bytes | None:
        """The text that arrives for a command of the vision service."""
        self.link.publish(TWIST, b"", DRIVE)
        self.advance()
        message = self.twists.take()
        return message and message.payload

    def status(self) -> tuple[Stamp, Status]:
        self.link._post_status()
        self.advance()
        message = self.statuses.take()
        return decode(Stamp, message.header), decode(Status, message.payload, STATUS.max_payload_bytes)

    def send(self, verb: Verb, echo: Echo | None = None, source: str = "operator") -> Reply | None:
        header = RequestHeader(source=source, session="0000beef", seq=1, echo=echo)
        self.operator.publish(REQUEST, encode(header), encode(Request(id=7, verb=verb)), "operator")
        self.advance()
        self.advance()
        message = self.replies.take()
        return message and decode(Reply, message.payload, REPLY.max_payload_bytes)

    def image(self, after_us: int = 100_000, session: str = "0000abcd") -> None:
        """An image of the robot. A new session is a new connection."""
        self.network.advance(self.network.now_us + after_us)
        header = FrameHeader(session=session, seq=1, t_us=self.network.now_us)
        self.far.publish(FRAME, encode(header), b"an image")
        self.advance()

    def request(self, verb: Verb, echo: Echo | None = None, source: str = "operator") -> Reply:
        """Send a request to a robot that sends images, as `Operator` does: again without a reply."""
        for _ in range(3):
            if (reply := self.send(verb, echo, source)) is not None:
                return reply
            self.image()
        raise AssertionError("no reply")


@pytest.fixture
def bench():
    made = Bench()
    yield made
    made.link.close()


def test_commands_pass_from_the_start(bench):
    assert bench.drive() == DRIVE
    _, status = bench.status()
    assert (status.state, status.applied, status.accepted, status.frame_age_us) == ("ACTIVE", (0.2, -0.35), 1, None)


@pytest.mark.parametrize("verbs", [(), (Verb.DISARM,), (Verb.STOP,), (Verb.STOP, Verb.RESET)])
def test_status_names_the_vision_service_and_the_command_that_is_next(bench, verbs):
    for verb in verbs:
        bench.request(verb, Echo.of(bench.status()[0]))
    _, status = bench.status()
    assert status.holder.source == "vision"
    command = {"STOPPED": "sightline reset r1", "DISARMED": "sightline arm r1"}
    assert next_step("r1", status) == command.get(status.state, "")


@pytest.mark.parametrize("period_us", [40_000, 200_000, 500_000])
def test_status_counts_the_images_of_the_last_second(bench, period_us):
    assert bench.status()[1].stream.fps == 0
    for count in range(1, 60):
        bench.image(period_us - 20_000)  # `image` and `status` advance the clock by the rest
        stream = bench.status()[1].stream
        assert stream.sent == count and stream.fps == min(count, 1_000_000 // period_us)
    bench.network.advance(bench.network.now_us + 1_000_000)
    assert bench.status()[1].stream.fps == 0


@pytest.mark.parametrize(("verb", "state"), [(Verb.STOP, "STOPPED"), (Verb.DISARM, "DISARMED")])
def test_stop_and_disarm_send_zero_at_once_and_hold_later_commands_at_zero(bench, verb, state):
    bench.drive()
    bench.send(verb)
    assert bench.twists.take().payload == ZERO
    assert decode(Detections, bench.boxes.take().payload).boxes == ()
    reply = bench.request(verb)
    assert (reply.ok, reply.state) == (True, state)
    assert bench.drive() == ZERO
    found = Detections(width_px=160, height_px=120, boxes=(
        DetectedBox(label="ball", score=1, x1_px=1, y1_px=1, x2_px=9, y2_px=9),))
    bench.link.publish(DETECTIONS, b"", encode(found))
    bench.advance()
    assert decode(Detections, bench.boxes.take().payload).boxes == ()
    assert bench.status()[1].applied == (0.0, 0.0)


@pytest.mark.parametrize(("verb", "state"), [(Verb.STOP, "STOPPED"), (Verb.DISARM, "DISARMED")])
def test_stop_and_disarm_of_a_robot_out_of_reach_are_not_confirmed(bench, verb, state):
    bench.image()
    bench.drive()
    assert bench.send(verb) is None
    bench.image(50_000)  # it was in flight
    assert bench.drive() == ZERO
    assert bench.status()[1].applied == (0.2, -0.35)
    assert bench.send(verb) is None
    bench.network.advance(bench.network.now_us + 1_000_000)
    reply = bench.send(verb)
    assert (reply.ok, reply.state) == (False, "ACTIVE") and "cut its power by hand" in reply.detail
    _, status = bench.status()
    assert (status.state, status.applied) == ("ACTIVE", (0.2, -0.35)) and "zero is not delivered" in status.reason
    bench.image()
    _, status = bench.status()
    assert (status.state, status.applied) == (state, (0.0, 0.0)) and "zero" not in status.reason
    assert bench.send(verb).ok


def test_first_image_of_a_new_connection_shows_no_delivery(bench):
    """The connection before may have lost the zero, which the link repeats on the new one."""
    bench.image()
    bench.drive()
    assert bench.send(Verb.STOP) is None
    bench.image(500_000, session="0000abce")
    assert bench.status()[1].state == "ACTIVE"
    bench.image(session="0000abce")
    assert bench.status()[1].state == "STOPPED"


def test_motion_after_arm_needs_another_delivery(bench):
    bench.request(Verb.DISARM)
    bench.request(Verb.ARM, Echo.of(bench.status()[0]))
    bench.drive()
    assert bench.send(Verb.STOP) is None and bench.status()[1].applied == (0.2, -0.35)


def test_malformed_header_of_an_image_shows_no_delivery(bench):
    bench.send(Verb.STOP)
    bench.network.advance(bench.network.now_us + 200_000)
    bench.far.publish(FRAME, b"{", b"an image")
    bench.advance()
    assert bench.status()[1].state == "ACTIVE" and not bench.link.rejected


def test_after_a_stop_only_reset_and_arm_with_a_new_status_permit_motion(bench):
    before = Echo.of(bench.status()[0])
    bench.request(Verb.STOP)
    assert bench.request(Verb.RESET, before).detail.startswith("STALE")
    assert bench.request(Verb.RESET).detail.startswith("STALE")
    new = Echo.of(bench.status()[0])
    assert bench.request(Verb.ARM, new).detail.startswith("STOPPED")
    assert bench.request(Verb.RESET, new).state == "DISARMED"
    assert bench.drive() == ZERO
    assert bench.request(Verb.ARM, new).state == "ACTIVE"
    assert bench.drive() == DRIVE


def test_disarm_does_not_clear_a_stop(bench):
    bench.request(Verb.STOP)
    assert bench.request(Verb.DISARM).state == "STOPPED"


def test_a_request_of_another_source_than_its_key_changes_nothing(bench):
    assert bench.request(Verb.STOP, source="teleop").detail.startswith("UNKNOWN_SOURCE")
    assert bench.drive() == DRIVE


def test_a_second_driver_is_rejected(bench):
    assert bench.request(Verb.ACQUIRE, Echo.of(bench.status()[0])).detail.startswith("NOT_ALLOWED")


def test_the_printed_option_sets_the_assumed_camera():
    camera = assumed_camera(JpegSize(640, 480, 3))
    assert (camera.fx_px, camera.cx_px, camera.calibrated) == (554.3, 320, False)
    option = camera_line(camera).rpartition("--set ")[2].strip("'")
    assert load_service("vision", file=None, sets=[option], options={}, environ={}).config.camera == camera


@pytest.mark.parametrize(("endpoint", "fix"), [
    ("ws-legacy://127.0.0.1:9091", "does its program send images?"),
    ("tcp/127.0.0.1:7447", "is `sightline robot` running there, with this robot id?"),
])
def test_silence_of_a_robot_is_reported_with_the_fix_for_its_kind(bench, monkeypatch, endpoint, fix):
    said = []
    service = Service(VisionConfig(connect=(endpoint,)), bench.link, said.append)
    monkeypatch.setattr("sightline.vision_side.serving.service._SILENCE_S", -1.0)
    service.turn(0.0)
    assert said[-1] == f"vision: no frames from robot r1 at {endpoint}; {fix}"


def test_a_service_assumes_a_camera_for_a_legacy_robot_once_and_drives(bench):
    said = []
    service = Service(VisionConfig(connect=("ws-legacy://127.0.0.1:9091",)), bench.link, said.append)
    for seq in range(1, 4):
        header = FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333)
        bench.far.publish(FRAME, encode(header), jpeg_of(scene(camera(), 1.0, 0.2, shaded=True)))
        bench.advance()
        service.turn(0.0)
        bench.advance()
    assert bench.twists.take().payload != ZERO
    (box,) = decode(Detections, bench.boxes.take().payload).boxes
    assert box.x1_px < box.x2_px
    assert sum("publishes no camera model; assuming 60 degrees" in line for line in said) == 1


def answered(bench, service, seq, image):
    """Return what reaches the robot after one more image."""
    header = FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333)
    bench.far.publish(FRAME, encode(header), image)
    bench.advance()
    service.turn(0.0)
    bench.advance()
    return bench.twists.take()


@pytest.mark.parametrize("kind", ["hsv", "boxes"])
def test_service_assumes_another_camera_for_another_image_size(bench, kind):
    said = []
    config = LEGACY.model_copy(update={"detector": DetectorConfig(kind=kind)})
    service = open_service(config, bench.link, said.append)
    sizes = (320, 240), (640, 480), (320, 240)
    for seq in range(12):
        shown = camera(*sizes[seq // 4])
        twist = answered(bench, service, seq + 1, jpeg_of(scene(shown, 1.0, 0.2, shaded=True)))
        assert kind == "boxes" or twist is not None
    assumed = [line for line in said if "assuming 60 degrees" in line]
    assert [line.split("width_px = ")[1].split(",")[0] for line in assumed] == ["320", "640", "320"]
    assert not service.skipped


def test_configured_camera_of_a_legacy_robot_stays_with_images_of_another_size(bench):
    said = []
    service = Service(LEGACY.model_copy(update={"camera": camera()}), bench.link, said.append)
    large = jpeg_of(scene(camera(640, 480), 1.0, 0.2, shaded=True))
    assert [answered(bench, service, seq, large) for seq in (1, 2)] == [None, None]
    assert service.skipped == {"MALFORMED": 2} and "assuming" not in " ".join(said)


@pytest.mark.parametrize("size_px", [(8, 8), (15, 240), (240, 15), (8193, 16), (16, 8193)])
def test_image_of_a_size_that_no_camera_has_is_logged_once_and_ends_nothing(bench, size_px):
    said = []
    service = Service(LEGACY, bench.link, said.append)
    image = jpeg_of(np.full((size_px[1], size_px[0], 3), 140, np.uint8))
    assert [answered(bench, service, seq, image) for seq in (1, 2)] == [None, None]
    words = f"cannot assume a camera model: image is {size_px[0]}x{size_px[1]}, each side must have 16 to 8192 pixels"
    assert sum(words in line for line in said) == 1
    assert answered(bench, service, 3, jpeg_of(scene(camera(), 1.0, 0.2, shaded=True))) is not None


@pytest.mark.parametrize("size_px", [(16, 8192), (8192, 16)])
def test_camera_is_assumed_up_to_the_limits_of_its_model(size_px):
    shown = assumed_camera(JpegSize(*size_px, 3))
    assert (shown.width_px, shown.height_px) == size_px


def test_without_a_target_the_list_of_boxes_is_empty():
    shown = camera()
    assert decode(Detections, target_box(None, shown)).boxes == ()
    target = Detection(x1_px=1, y1_px=2, x2_px=3, y2_px=4, score=1.0, label="")
    (box,) = decode(Detections, target_box(target, shown)).boxes
    assert (box.label, box.x1_px, box.y2_px) == ("target", 1, 4)
