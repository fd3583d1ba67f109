"""The story: figures from the motor log, captions, the order of scenes, and what the drawing shows of them."""

import socket
import threading
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sightline.evaluation.baselines.naive import LastCommand, NaiveRobot
from sightline.evaluation.demo import story as st
from sightline.evaluation.demo import story_run
from sightline.evaluation.demo.relay import pump
from sightline.evaluation.demo.story_film import (
    CLOSING_S,
    GREEN,
    HEIGHT_PX,
    RED,
    VIEW_PX,
    WIDTH_PX,
    YELLOW,
    ChaseCamera,
    Page,
    age_color,
    robot_view,
    truth_at,
    write_story,
)
from sightline.evaluation.demo.story_run import SCENE, check_space, write_configuration
from sightline.evaluation.faults.evidence import MotorRow
from sightline.evaluation.scenario_config import robot_of
from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import CheckError, ConfigError
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader, Twist
from sightline.protocol.transports.link import Message
from sightline.robot_side.ports import Picture, WheelAngles
from sightline.sim.truth import Truth

RADIUS_M = 0.035
FAST_RAD_S = 0.4 / RADIUS_M


def truth(t_us: int, **changes) -> Truth:
    still = Truth(
        t_us=t_us, x_m=0.0, y_m=0.0, yaw_rad=0.0, linear_mps=0.0, angular_rad_s=0.0, target_x_m=0.6, target_y_m=0.0,
        target_z_m=0.1, bearing_rad=0.0, distance_m=0.5, visible=True, wall_contacts=0, target_contacts=0,
        target_contacts_by_robot=0)
    return replace(still, **changes)


def motors(*spans: tuple[float, float, float]) -> list[MotorRow]:
    """Rows at 50 Hz; each span: from and to in seconds, speed in rad/s that the wheels have at once."""
    rows, angle_rad = [], 0.0
    for from_s, to_s, speed in spans:
        for number in range(round(from_s * 50), round(to_s * 50)):
            rows.append(MotorRow(number * 20_000, speed, speed, angle_rad, angle_rad))
            angle_rad += speed * 0.02
    return rows


def safe_take(zero_s: float = 10.5) -> st.Take:
    """Follows from 0 s, loses the radio at 10 s and stands from `zero_s`; then the vision service, then STOP."""
    events = {"wifi lost": 10, "wifi back": 14, "vision killed": 20, "vision back": 24, "STOP": 30, "end": 34}
    take = st.Take(st.SAFE_NAME, events={name: round(at_s * 1e6) for name, at_s in events.items()})
    take.motors = motors((0, zero_s, FAST_RAD_S), (zero_s, 15, 0), (15, 20.4, FAST_RAD_S), (20.4, 25, 0),
                         (25, 30.3, FAST_RAD_S), (30.3, 34, 0))
    take.truths = [truth(number * 20_000) for number in range(34 * 50)]
    return take


def naive_take(hit_s: float = 12.0) -> st.Take:
    take = st.Take(st.NAIVE_NAME, events={"wifi lost": 10_000_000, "wall": round(hit_s * 1e6), "end": 14_000_000})
    take.motors = motors((0, 14, FAST_RAD_S))
    take.truths = [truth(number * 20_000) for number in range(14 * 50)]
    return take


@pytest.fixture
def story() -> st.Story:
    return st.compose(safe_take(), naive_take())


# --- figures ---------------------------------------------------------------------------------------------------------


def test_stop_figure_comes_from_the_motor_log(story):
    assert story.wifi.ms == pytest.approx(500, abs=20)
    assert story.wifi.m == pytest.approx(0.20, abs=0.01)
    assert story.naive_m == pytest.approx(0.80, abs=0.01)
    assert story.naive_mps == pytest.approx(0.4)
    assert all(check.ok for check in story.checks), story.checks


def test_a_slow_stop_fails_the_check():
    late = st.compose(safe_take(zero_s=10.9), naive_take())
    assert {check.name for check in late.checks if not check.ok} == {
        "Wi-Fi lost: wheels at zero", "Wi-Fi lost: distance"}


def test_wheels_that_never_stop_are_an_error():
    with pytest.raises(CheckError, match="not at zero between 'wifi lost' and 'wifi back'"):
        st.compose(safe_take(zero_s=15), naive_take())


def test_naive_robot_without_wall_is_an_error():
    naive = naive_take()
    del naive.events["wall"]
    with pytest.raises(CheckError, match="met no wall"):
        st.compose(safe_take(), naive)


def test_wall_contact_before_the_loss_does_not_count():
    truths = [truth(at, wall_contacts=hits) for at, hits in ((0, 0), (10, 1), (20, 1), (30, 2))]
    assert st.wall_us(truths, 10) == 30
    assert st.wall_us(truths, 0) == 10
    assert st.wall_us(truths, 30) is None


def test_radio_is_lost_where_a_robot_that_keeps_its_command_meets_the_wall():
    on_the_way = {"x_m": 1.2, "yaw_rad": 0.05, "linear_mps": 0.35}
    fast, slow = st.Arrival(100, 60, 0.34), st.Arrival(200, 160, 0.1)
    assert st.heads_for_wall(truth(0, **on_the_way), [slow, fast])
    assert not st.heads_for_wall(truth(0, **on_the_way), [fast, slow]), "it is about to brake"
    assert not st.heads_for_wall(truth(0, **on_the_way), [])
    for change in ({"x_m": 1.0}, {"yaw_rad": 1.57}, {"yaw_rad": -3.1}, {"linear_mps": 0.2}):
        assert not st.heads_for_wall(truth(0, **on_the_way | change), [fast])


def test_radio_comes_back_where_a_slower_command_had_passed_already():
    fast, slow = st.Arrival(100, 60, 0.34), st.Arrival(200, 160, 0.1)
    take, events, arriving = st.Take("naive", arrivals=[fast]), [], [slow, fast]

    def until(happened, _seconds, what):
        events.append(what)
        assert what != "way to the wall" or happened(truth(0, x_m=1.2, yaw_rad=0.0, linear_mps=0.35))

    def watch(_seconds):
        take.arrivals[:] = [arriving.pop(0)] if arriving else take.arrivals

    def send(name, number):
        events.append(number.name)
        take.arrivals[:] = [fast]

    stage = SimpleNamespace(take=take, until=until, watch=watch, mark=events.append,
                            processes=SimpleNamespace(signal=send))
    story_run._lose_radio(stage)
    again = ["way to the wall", "wifi lost", "SIGSTOP"]
    assert events == ["motion", "moving", *again, "SIGCONT", *again]


def test_frame_age_counts_from_the_newest_frame():
    arrivals = [st.Arrival(100, 60, 0.3), st.Arrival(200, 40, 0.3), st.Arrival(300, 250, 0.3)]
    ages = [st.age_us(arrivals, t_us) for t_us in (99, 100, 250, 300, 1300)]
    assert ages == [None, 40, 190, 50, 1050], "an old frame that comes late does not make the command older"


def test_speed_comes_from_the_faster_wheel():
    rows = [MotorRow(100, 2.0, -8.0, 0, 0), MotorRow(200, 0.0, 0.0, 0, 0)]
    assert [round(st.speed_mps(rows, at), 3) for at in (99, 100, 199, 200)] == [0.0, 0.28, 0.28, 0.0]


# --- captions and scenes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("at_s", "caption", "tone"), [
    (9.9, "A vision service steers the robot over Wi-Fi.", "calm"), (10.2, "Wi-Fi lost", "lost"),
    (11.0, "Wi-Fi lost. Wheels at zero after 500 ms, 20 cm.", "safe"),
    (16.0, "Wi-Fi is back. The robot follows again.", "calm"), (20.1, "Vision service killed", "lost"),
    (21.0, "Vision service killed. Wheels at zero after 400 ms, 16 cm.", "safe"),
    (26.0, "The vision service is back. The robot follows again.", "calm"), (30.1, "Operator: STOP", "lost"),
    (31.0, "Operator: STOP. Wheels at zero after 300 ms, 12 cm.", "safe"),
])  # fmt: skip
def test_caption_follows_the_events(story, at_s, caption, tone):
    seen = st.shot(story, story.safe, round(at_s * 1e6))
    assert (seen.caption, seen.tone) == (caption, tone)


@pytest.mark.parametrize(("at_s", "caption", "tone"), [
    (9.0, "Same scene, a naive robot: it repeats its last command.", "calm"),
    (11.0, "Wi-Fi lost. It drives on: 40 cm", "lost"), (13.0, "Into the wall after 80 cm. Wheels at 0.40 m/s.", "bad"),
])  # fmt: skip
def test_caption_of_the_naive_robot_counts_its_way(story, at_s, caption, tone):
    seen = st.shot(story, story.naive, round(at_s * 1e6))
    assert (seen.caption, seen.tone) == (caption, tone)


def test_shot_shows_what_works_and_the_published_state(story):
    story.safe.states += [st.StateAt(0, "ACTIVE"), st.StateAt(10_400_000, "HOLD")]
    shots = [st.shot(story, story.safe, round(at_s * 1e6)) for at_s in (9, 11, 15, 21, 25)]
    assert [one.wifi for one in shots] == [True, False, True, True, True]
    assert [one.vision for one in shots] == [True, True, True, False, True]
    assert [one.state for one in shots] == ["ACTIVE", "HOLD", "HOLD", "HOLD", "HOLD"]
    assert st.shot(story, story.naive, 13_000_000).wifi is False, "the take ends before the radio is back"


def test_film_lasts_25_to_30_seconds(story):
    images = sum(len(scene.times_us(10.0)) for scene in st.scenes(story))
    assert 25 <= images / 10 + CLOSING_S <= 30
    first = st.scenes(story)[0]
    assert first.times_us(2.0)[:2] == [first.from_us, first.from_us + 500_000]


# --- drawing ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("story")
    scenario = write_configuration(folder, "/nowhere", 1)
    return scenario, robot_of(scenario)


def test_age_color_changes_at_the_limits_of_the_robot():
    ages = [age_color(ms * 1000) for ms in (0, 150, 151, 400, 401)]
    assert ages == [GREEN, GREEN, YELLOW, YELLOW, RED]
    assert age_color(None) == RED


def test_age_bar_grows_with_the_age(story):
    grey, row_px = np.zeros((VIEW_PX[1], VIEW_PX[0], 3), np.uint8), 40 + VIEW_PX[1] + 16
    about = st.shot(story, story.safe, 5_000_000)
    lengths = []
    for age_us, color in ((100_000, GREEN), (300_000, YELLOW), (5_000_000, RED)):
        image = np.asarray(Page().compose(grey, grey, replace(about, age_us=age_us)))
        assert image.shape == (HEIGHT_PX, WIDTH_PX, 3)
        lengths.append(int((image[row_px] == color).all(axis=1).sum()))
    assert lengths[0] < lengths[1] < lengths[2]
    assert lengths[0] / lengths[2] == pytest.approx(100 / 800, abs=0.02)


def test_every_caption_fits_the_image():
    far = st.compose(safe_take(), naive_take(hit_s=13.9))
    slow = replace(far, vision=st.StopFigure(1234.0, 1.11), naive_m=1.99)
    times = [(take, t_us) for take in (slow.safe, slow.naive) for t_us in range(0, take.events["end"], 200_000)]
    page = Page()
    for take, t_us in times:
        assert page.caption_px(st.shot(slow, take, t_us).caption) <= WIDTH_PX - 20


def test_chase_camera_shows_robot_and_ball(scene):
    with closing(ChaseCamera(*scene, 160, 120)) as camera:
        ahead = camera.draw(truth(0, x_m=-1.5, target_x_m=-0.9)).astype(int)
        left = camera.draw(truth(20_000, x_m=-1.5, target_x_m=-0.9, target_y_m=0.3)).astype(int)
    blue = (ahead[..., 2] > ahead[..., 0] + 60).nonzero()
    assert blue[1].mean() == pytest.approx(80, abs=4), "the robot is in the middle"
    wheels = (ahead.max(axis=2) < 60).nonzero()[1]
    assert (wheels < blue[1].min()).any() and (wheels > blue[1].max()).any(), "a wheel on either side"
    columns = [((one[..., 0] > one[..., 2] + 80).nonzero()[1]).mean() for one in (ahead, left)]
    assert columns[0] == pytest.approx(80, abs=4)
    assert columns[1] < columns[0] - 10, "a ball to the left is drawn on the left"


def test_robot_view_is_darker_when_its_frame_is_old():
    import cv2

    jpeg = bytes(cv2.imencode(".jpg", np.full((240, 320, 3), 200, np.uint8))[1])
    take = st.Take("robot", images=[st.Image(1_000_000, jpeg)])
    assert robot_view(take, 999_999).max() == 0, "nothing before the first frame"
    assert robot_view(take, 1_100_000).mean() == pytest.approx(200, abs=2)
    assert robot_view(take, 1_500_000).mean() == pytest.approx(90, abs=2)


def test_truth_at_is_the_newest_so_far():
    truths = [truth(10), truth(20), truth(30)]
    assert [truth_at(truths, at).t_us for at in (0, 10, 29, 99)] == [10, 10, 20, 30]


def test_film_that_cannot_be_written_is_one_line(tmp_path, story, scene):
    with pytest.raises(ConfigError, match=r"cannot be written: .*; pass another folder with --out"):
        write_story(tmp_path / "gone" / "story.webp", story, *scene, show=lambda _line: None, fps=0.2)


def test_place_that_is_too_small_is_one_line(tmp_path):
    check_space(tmp_path, 10_000_000)
    with pytest.raises(ConfigError, match=r"9\.9 MB free, the story needs 10 MB; free some space"):
        check_space(tmp_path, 9_900_000)


def test_film_loops_and_holds_its_last_image(tmp_path, story, scene):
    from PIL import Image

    lines, lasting_ms = [], 0
    images = write_story(tmp_path / "story.webp", story, *scene, show=lines.append, fps=0.4)
    with Image.open(tmp_path / "story.webp") as film:
        assert (film.info["loop"], film.size) == (0, (WIDTH_PX, HEIGHT_PX))
        for number in range(film.n_frames):  # equal images are one of longer duration
            film.seek(number)
            film.load()
            lasting_ms += film.info["duration"]
        assert film.info["duration"] == CLOSING_S * 1000
    assert lasting_ms == (images - 1) * 2500 + CLOSING_S * 1000
    assert [line for line in lines if line.startswith("filming")] == [
        f"filming {number} of 5: {name}" for number, name in enumerate([st.SAFE_NAME] * 4 + [st.NAIVE_NAME], 1)]


# --- the naive robot and the relay -----------------------------------------------------------------------------------


class FakeDevices:
    """A drive that stores what it is given, and a camera with one image."""

    def __init__(self) -> None:
        self.given: list[tuple[float, float]] = []
        self.ending = threading.Event()

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        self.given.append((left_rad_s, right_rad_s))
        if len(self.given) == 5:
            self.ending.set()

    def wheels(self) -> WheelAngles:
        return WheelAngles(0.0, 0.0, 20_000 * len(self.given))

    def read(self, _timeout_s: float) -> Picture:
        self.ending.set()
        return Picture(b"jpeg", 77, 100)


class FakeLink:
    def __init__(self) -> None:
        self.published: list[tuple[object, bytes, bytes]] = []

    def subscribe(self, channel, callback) -> None:
        assert channel is TWIST
        self.take = callback

    def publish(self, channel, header, payload, source="") -> bool:
        self.published.append((channel, header, payload))
        return True


def command(text: bytes) -> Message:
    echo = Echo(channel="frame", session="00000001", seq=1, t_us=5)
    return Message(TWIST, "vision", encode(AnswerHeader(source="vision", session="00000002", seq=1, echo=echo)), text)


def test_naive_robot_repeats_its_last_command_forever():
    link, devices = FakeLink(), FakeDevices()
    robot = NaiveRobot(link, devices, devices)
    link.take(command(b"0.2100|0.0000"))
    robot.drive(devices.ending)
    assert devices.given[:5] == [pytest.approx((6.0, 6.0))] * 5
    assert devices.given[5:] == [(0.0, 0.0)], "only its end stops the wheels"


def test_naive_robot_sends_frames_with_its_applied_twist(scene):
    link, devices = FakeLink(), FakeDevices()
    devices.model = scene[1].camera.camera_model()
    robot = NaiveRobot(link, devices, devices)
    link.take(command(b"0.2000|-0.1000"))
    robot.stream(devices.ending)
    header, jpeg = next((header, payload) for channel, header, payload in link.published if channel is FRAME)
    sent = decode(FrameHeader, header)
    assert (sent.t_us, sent.applied, jpeg) == (77, (0.2, -0.1), b"jpeg")


def test_invalid_command_changes_nothing():
    stored = LastCommand()
    stored.take(command(b"0.2000|0.1000"))
    stored.take(command(b"nan|0"))
    assert stored.twist == Twist(linear_mps=0.2, angular_rad_s=0.1)


def test_relay_passes_bytes_and_the_end():
    outer, inner = socket.socketpair()
    far, near = socket.socketpair()
    far.settimeout(5.0)
    passing = threading.Thread(target=pump, args=(inner, near), name="pump", daemon=True)
    passing.start()
    outer.sendall(b"frame")
    assert far.recv(16) == b"frame"
    outer.close()
    assert far.recv(16) == b"", "the end passes too"
    passing.join(5)
    assert not passing.is_alive()
    for end in (inner, far, near):
        end.close()


def test_the_scene_has_a_wall_ahead_of_the_radio_loss(scene):
    from sightline.evaluation.demo.story_run import OUTAGE_S

    nearest_m = min(wall.start_m[0] for wall in scene[0].walls if wall.start_m[0] > st.LOST_AT_X_M) - st.LOST_AT_X_M
    assert nearest_m < OUTAGE_S * SCENE["target"]["speed_mps"], "the outage lasts until a robot that drives on is there"
