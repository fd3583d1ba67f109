"""A camera that fails under a real robot service: one line, nothing moves, the service stays where it can."""

import pytest

from tests.fixtures.cameras import jpeg, video
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision, driving


@pytest.mark.slow
def test_end_of_a_video_is_logged_once_and_the_service_stays(tmp_path):
    film = video(tmp_path / "film.avi", pictures=120)
    camera = {"kind": "video", "options": {"path": str(film), "loop": False}}
    with RobotProcess(tmp_path, camera=camera) as robot, Vision(robot.endpoint):
        assert driving(robot)
        assert until(lambda: "ended after" in robot.output(), 15)
        assert until(lambda: robot.speed() == 0.0, 5)
        assert robot.process.poll() is None
        assert robot.output().count("camera: video") == 1
        assert robot.output().count("Traceback") == 1


@pytest.mark.parametrize(
    ("kind", "options", "code", "said"),
    [
        ("v4l2", {"device": "/dev/video93"}, 3, "camera /dev/video93 is not there"),
        ("picamera", {}, 2, "camera picamera needs picamera2: sudo apt install python3-picamera2"),
        ("still", {"path": "/nowhere.jpg"}, 3, "image /nowhere.jpg cannot be read"),
        ("video", {"path": "/nowhere.mp4"}, 3, "video /nowhere.mp4 is not there"),
        ("v4l3", {}, 2, "did you mean 'v4l2'"),
    ],
)
def test_a_camera_that_is_not_there_at_start_is_one_line(tmp_path, kind, options, code, said):
    with RobotProcess(tmp_path, camera={"kind": kind, "options": options}) as robot:
        assert robot.process.wait(15) == code
        lines = [line for line in robot.output().splitlines() if line.startswith("error: ")]
        assert len(lines) == 1
        assert said in lines[0]
        assert "Traceback" not in robot.output()
        assert robot.speed() == 0.0


def test_a_damaged_still_is_one_line(tmp_path):
    (tmp_path / "cut.jpg").write_bytes(jpeg()[:100])
    camera = {"kind": "still", "options": {"path": str(tmp_path / "cut.jpg")}}
    with RobotProcess(tmp_path, camera=camera) as robot:
        assert robot.process.wait(15) == 3
        assert "remove it or convert it to a plain JPEG" in robot.output()
