"""`watch`, `capture`, `pick-color` at a robot in the simulation and its vision, and in a real browser."""

import csv
import json
import os
import re
import signal
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import av
import cv2
import pytest
from mcap.reader import make_reader

from sightline.operator_side.cli.app import run
from sightline.operator_side.client.pictures import Shot
from sightline.operator_side.cockpit.http_server import HttpAnswer, Route, as_json, page, served
from sightline.operator_side.recording.film import Film, film
from sightline.operator_side.recording.recorder import read_recording
from sightline.protocol.channels import FRAME
from sightline.protocol.codec import decode
from sightline.protocol.messages import FrameHeader
from tests.e2e.javascript.test_browser import LEVELS, WINDOWS, Started, place
from tests.fixtures.cameras import jpeg
from tests.fixtures.javascript import Browser, chromium
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.vision.remote import BALL_JPEG
from tests.operator_side.calibrate.test_color import ball_picture

pytestmark = pytest.mark.slow  # all share a simulation and a vision service that compute throughout


class Site:
    """A simulated robot on both transports, and its vision."""

    def __init__(self, folder: Path, ending: ExitStack) -> None:
        self.folder = folder
        self.zenoh, self.web = free_endpoint(), free_endpoint("ws://")
        sockets = f"/tmp/sl-{os.getpid()}-{self.zenoh.rpartition(':')[2]}"
        device = f'{{kind = "sim", options = {{socket_dir = "{sockets}"}}}}'
        (folder / "robot.toml").write_text(f'listen = ["{self.zenoh}", "{self.web}"]\nstate_dir = "{folder}/state"\n'
                                           # A busy machine's stream would be of coarser JPEGs, in which an edge of
                                           # the ball comes apart.
                                           f"camera = {device}\ndrive = {device}\nstream = {{adapt = false}}\n")
        sim = ("sim", "--scenario", "static", "--seed", "11", "--socket-dir", sockets)
        assert ending.enter_context(Started(folder, *sim)).says("simulation ready")
        robot = ending.enter_context(Started(folder, "robot", "--config", str(folder / "robot.toml")))
        assert robot.says(re.escape(self.web))
        self.vision = ending.enter_context(Started(folder, "vision", "--connect", self.zenoh))
        assert self.vision.says("target seen|searching")

    def at(self, end: str) -> str:
        """The endpoint of that transport."""
        return self.web if end == "web" else self.zenoh


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with ExitStack() as ending:
        yield Site(tmp_path_factory.mktemp("site"), ending)


def address_of(command: Started) -> str:
    """Return the address of its page."""
    assert command.says(r"http://127\.0\.0\.1:\d+/")
    return str(re.findall(r"http://127\.0\.0\.1:\d+/", Path(command._log.name).read_text())[-1])


@pytest.mark.parametrize("end", ["zenoh", "web"])
def test_any_channel_is_printed(site: Site, end: str, capsys: pytest.CaptureFixture[str]) -> None:
    for channel, field in (("status", "state"), ("camera", "fx_px"), ("overlay", "bytes"), ("frame", "bytes"),
                           ("report", "mission")):
        where = ["watch", "r1", channel, "--connect", site.at(end), "--count", "2", "--seconds", "10"]
        assert run([*where, "--json"]) == 0
        lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert [one["channel"] for one in lines] == [channel] * 2 and field in lines[0]["payload"]
        assert lines[1]["header"]["seq"] > lines[0]["header"]["seq"]
    assert run(["watch", "r1", "status", "--connect", site.at(end), "--count", "1"]) == 0
    assert re.match(r"status #\d+: state=DISARMED reason=", capsys.readouterr().out)


@pytest.mark.parametrize("end", ["zenoh", "web"])
def test_the_target_is_printed_as_a_line_an_object_and_a_table(
    site: Site, end: str, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["watch", "r1", "target", "--connect", site.at(end), "--count", "2", "--seconds", "10"]
    assert run([*where, "--json"]) == 0
    first, second = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert first["robot"] == "r1" and first["label"] == "ball" and 0.2 < first["distance_m"] < 3.0
    assert 0 < second["t_us"] - first["t_us"] < 1_000_000, "of new images"
    assert run([*where, "--csv"]) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert len(rows) == 2 and list(rows[0]) == list(first) and float(rows[0]["bearing_rad"]) == pytest.approx(
        first["bearing_rad"], abs=0.05)
    assert run(where) == 0
    assert re.fullmatch(r"( *[+-]\d+\.\d deg +\d\.\d\d m  ball \d\.\d\d at .* px, radius .* \(\w+\)\n){2}",
                        capsys.readouterr().out)


def test_invalid_watch_is_one_line(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, code, words in (
        (["r1", "fram"], 2, "unknown channel 'fram'; did you mean 'frame'?"),
        (["r1", "--json"], 2, "name it"), (["r1", "tagret"], 2, "unknown channel 'tagret'; did you mean 'target'?"),
        (["r1", "status", "--csv"], 2, "--csv is for the target"), (["r1", "--csv"], 2, "--csv is for the target"),
        (["r1", "target", "--csv", "--json"], 2, "--csv is for the target"),
        (["r1", "twist", "--connect", site.web, "--seconds", "1"], 4, "deliver it to the robot only"),
        (["r1", "request", "--connect", site.zenoh, "--seconds", "0.5"], 4, "check its publisher, and connect by"),
        (["r1", "scan", "--connect", "tcp/127.0.0.1:1", "--seconds", "1"], 4, "tcp/127.0.0.1:1"),
    ):
        assert run(["watch", *arguments]) == code
        said = capsys.readouterr().err
        assert words in said and said.count("error: ") == 1 and said.splitlines()[-1].startswith("error: ")


def test_the_state_is_shown_in_the_terminal(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["watch", "r1", "--text", "--connect", site.zenoh, "--seconds", "2"]) == 0
    said = capsys.readouterr().out
    assert "state     DISARMED" in said and "mission   follow: " in said


@pytest.mark.parametrize("end", ["zenoh", "web"])
def test_snapshots_and_videos_are_written(
    site: Site, end: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["capture", "r1", "--connect", site.at(end)]
    plain, drawn, film = tmp_path / "plain.png", tmp_path / "drawn.jpg", tmp_path / "drawn.mp4"
    assert run([*where, "--out", str(plain)]) == 0
    assert run([*where, "--out", str(drawn), "--overlay", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["channel"] == "overlay"
    assert plain.read_bytes()[:4] == b"\x89PNG" and drawn.read_bytes()[:2] == b"\xff\xd8"
    assert cv2.imread(str(drawn)).shape == (480, 640, 3) and cv2.imread(str(plain)).shape[2] == 3
    assert run([*where, "--out", str(film), "--overlay", "--seconds", "1.5", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    with av.open(str(film)) as opened:
        times_s = [frame.time for frame in opened.decode(video=0)]
    assert said["frames"] == len(times_s) >= 8 and 0.8 < times_s[-1] - times_s[0] <= 1.5
    assert times_s == sorted(times_s)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["drawn.jpg", "drawn.mp4", "plain.png"]


def test_video_lasts_as_long_as_wanted_by_the_capture_times(tmp_path: Path) -> None:
    """The first image comes 100 ms late, so that 1.1 s of images come within a second."""

    class Played:
        shots = iter([Shot(FRAME, BALL_JPEG, "0000000a", at, at * 100_000, 320, 240) for at in range(1, 90)])

        def take(self, _seconds: float) -> Shot:
            return next(self.shots)

    captured = film(Played(), tmp_path / "run.mp4", FRAME, 1.0)
    assert (captured.frames, captured.seconds) == (11, 1.0)


@pytest.mark.parametrize(("end", "more"), [("zenoh", {"twist/vision"}), ("web", set())])
def test_recording_has_what_the_link_delivers(site: Site, tmp_path: Path, end: str, more: set[str]) -> None:
    file = tmp_path / "run.mcap"
    where = ["--connect", site.at(end), "--seconds", "2", "--out", str(file), "--overlay"]
    assert run(["capture", "r1", *where]) == 0
    with file.open("rb") as opened:
        schemas = {channel.topic: schema.name for schema, channel, _ in make_reader(opened).iter_messages()}
    topics = {"frame", "status", "camera", "transform", "overlay/vision"} | more
    assert topics <= set(schemas) and schemas["frame"] == schemas["overlay/vision"] == "foxglove.CompressedImage"
    times_us = [decode(FrameHeader, one.message.header).t_us for one in read_recording(file)
                if one.message.channel is FRAME]
    assert 1.0 < (times_us[-1] - times_us[0]) / 1e6 < 4.0 and len(times_us) > 10


def test_video_that_ends_early_is_complete(site: Site, tmp_path: Path) -> None:
    film = tmp_path / "run.mp4"
    where = ("r1", "--connect", site.zenoh, "--seconds", "60", "--out", str(film))
    with Started(tmp_path, "capture", *where) as capturing:
        assert until(lambda: any(one.stat().st_size > 0 for one in tmp_path.glob(".run.mp4.*.mp4")), START_S)
        assert not until(lambda: capturing.process.poll() is not None, 1.5)
        capturing.process.send_signal(signal.SIGINT)
        assert capturing.process.wait(10) == 0
        assert capturing.says(r"run\.mp4: frame of r1, \d+x\d+, \d+ images in [\d.]+ s")
    with av.open(str(film)) as opened:
        assert sum(1 for _ in opened.decode(video=0)) > 3
    assert not list(tmp_path.glob(".*"))


def test_a_capture_without_a_robot_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nobody = ["--connect", "tcp/127.0.0.1:1"]
    for arguments, code, words in (
        (["--out", str(tmp_path / "x.gif")], 2, "ends in .png or .jpg, a video in .mp4"),
        (["--out", str(tmp_path / "x.png"), "--seconds", "3"], 2, "--seconds needs a video"),
        (["--out", str(tmp_path / "none" / "x.png")], 2, "no folder"),
        (["--out", str(tmp_path / "x.mp4"), *nobody], 4, "tcp/127.0.0.1:1"),
    ):
        assert run(["capture", *arguments]) == code
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_color_is_picked_from_the_images_of_a_robot(
    site: Site, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--connect", site.web, "--mask", str(tmp_path / "mask.png"), "--json"]
    assert run(["capture", "r1", "--connect", site.web, "--out", str(tmp_path / "now.png")]) == 0
    x_px, y_px = _yellow(cv2.imread(str(tmp_path / "now.png")))
    capsys.readouterr()
    assert run(["pick-color", "r1", "--at", f"{x_px},{y_px}", "--frames", "10", *where]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["trial"]["pictures"] == said["trial"]["with_any"] == 10 and 30 < said["ranges"][0]["hue_low_deg"] < 60
    assert cv2.imread(said["mask"]) is not None


def _yellow(picture):
    """The middle of the ball."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, (20, 130, 60), (34, 255, 255))
    return tuple(int(part[len(part) // 2]) for part in mask.nonzero()[::-1])


@pytest.mark.alone
def test_page_shows_the_overlay_and_frames_without_it(tmp_path: Path) -> None:
    chromium()
    with ExitStack() as ending:
        site = Site(tmp_path, ending)
        watch = ending.enter_context(Started(tmp_path, "watch", "r1", "--connect", site.web))
        page = ending.enter_context(Browser(tmp_path, address_of(watch)))
        assert until(lambda: re.fullmatch(r"overlay 640x480, \d+ images/s, at least \d+ ms old", page.text("age")),
                     START_S), page.text("age")
        assert until(lambda: page.text("state") == "DISARMED" and page.text("link") == "connected", START_S)
        assert until(lambda: "follow: " in page.text("lines") and "on cpu" in page.text("lines"), START_S)
        assert page.run(LEVELS)[2] >= 4
        page.screenshot(tmp_path / "overlay.png")
        site.vision.process.send_signal(signal.SIGKILL)
        assert until(lambda: page.text("age").startswith("frame "), START_S), page.text("age")
        with Started(tmp_path, "vision", "--connect", site.zenoh):
            assert until(lambda: page.text("age").startswith("overlay "), START_S), page.text("age")
        page.screenshot(tmp_path / "frame.png")
        watch.process.send_signal(signal.SIGINT)
        assert watch.process.wait(10) == 0
        assert until(lambda: page.text("link") == "`sightline watch` has ended", 5.0)
        # The page may notice the end before its newest image is 500 ms old.
        assert until(lambda: page.run("document.getElementById('figure').className") == "old", 1.0)
        assert page.errors == []


def test_page_shows_a_whole_image_of_any_shape_in_any_window(tmp_path: Path) -> None:
    chromium()
    shown = {"jpeg": jpeg(640, 480)}
    routes: dict[str, Route] = {
        "GET /": lambda _request, _body: page("watch.html", robot="r1"),
        "GET /watch.mjs": lambda _request, _body: page("watch.mjs"),
        "GET /picture": lambda _request, _body: HttpAnswer(shown["jpeg"], "image/jpeg", headers={
            "X-Number": "1", "X-Channel": "frame", "X-Age-Us": "0"}),
        "GET /state": lambda _request, _body: as_json(
            {"robot": "r1", "online": True, "state": "HOLD", "reason": "a reason", "lines": []}),
    }
    with served(routes, 0) as address, Browser(tmp_path, address) as browser:
        for size in ("640x480", "480x640", "16x4000", "4000x16"):
            shown["jpeg"] = jpeg(*map(int, size.split("x")))
            assert until(partial(_shows, browser, f"frame {size}"), START_S)
            for width, height in WINDOWS:
                top, bottom, left, right = place(browser, "picture", width, height)
                assert 0 <= top < bottom <= height and 0 <= left < right <= width, (size, width, height, bottom)


def _shows(browser: Browser, image: str) -> bool:
    return browser.text("age").startswith(image)


def test_a_color_is_picked_on_the_page_and_written(tmp_path: Path, site: Site) -> None:
    chromium()
    config = tmp_path / "vision.toml"
    config.write_text("# colors\n[hsv] # of mine\nshape = 'any'\n")
    where = ("--connect", site.zenoh, "--config", str(config))
    with Started(tmp_path, "pick-color", "r1", *where) as picking, Browser(tmp_path, address_of(picking)) as page:
        assert until(lambda: page.run(LEVELS)[2] >= 4, START_S)
        drag(page, 5, 5, 5, 5)
        assert until(lambda: "no color" in page.text("error") or "marks" in page.text("error"), 5.0)
        assert page.run("document.getElementById('use').disabled")
        page.click("again")
        x_px, y_px = page.run(MIDDLE_OF_YELLOW)
        drag(page, x_px, y_px, x_px, y_px)
        assert until(lambda: page.text("ranges").startswith("hue "), 5.0), page.text("error")
        assert until(lambda: page.run("document.getElementById('mask').naturalWidth") > 0, 5.0)
        assert page.text("error") == "" and re.search(r"in 1 blob; marks in (\d+) of \1 ", page.text("trial"))
        page.screenshot(tmp_path / "picked.png")
        page.click("use")
        assert until(lambda: page.text("note").startswith("written to "), 5.0), page.text("error")
        assert picking.process.wait(10) == 0
        assert page.errors == []
    assert 30 < tomllib.loads(config.read_text())["hsv"]["ranges"][0]["hue_low_deg"] < 60
    assert "# colors" in config.read_text() and "# of mine" in config.read_text()


def test_a_color_is_picked_in_a_video_by_its_box(tmp_path: Path) -> None:
    chromium()
    with Film(tmp_path / "run.mp4", 10) as film:
        for number in range(8):
            film.add(ball_picture(120 if number < 6 else 0, 1.0, 0.2, seed=number), number * 100_000)
    arguments = ("pick-color", "--video", str(tmp_path / "run.mp4"), "--frames", "8")
    with Started(tmp_path, *arguments) as picking, Browser(tmp_path, address_of(picking)) as page:
        assert until(lambda: page.run(LEVELS)[0] == 320, START_S)
        assert page.run("document.getElementById('pictures').max") == "8"
        page.run("(() => { const slider = document.getElementById('pictures'); slider.value = 2;"
                 "slider.dispatchEvent(new Event('input')); })()")
        assert until(lambda: "green" in colour_at(page, 110, 112), 5.0), colour_at(page, 110, 112)
        drag(page, 92, 92, 130, 134)
        assert until(lambda: page.text("ranges").startswith("hue 1"), 5.0), page.text("error")
        assert "marks in 6 of 8 images" in page.text("trial")
        page.run("document.getElementById('trial').scrollIntoView()")
        page.screenshot(tmp_path / "video.png")
        page.click("use")
        assert until(lambda: page.text("note") == "printed in the terminal", 5.0)
        assert picking.process.wait(10) == 0 and picking.says(r"\[hsv\]\nranges = \[")
        assert page.errors == []


def colour_at(page: Browser, x_px: int, y_px: int) -> str:
    """The strongest of the three there."""
    at = f"document.getElementById('picture').getContext('2d').getImageData({x_px}, {y_px}, 1, 1).data"
    levels = list(page.run(f"Array.from({at})"))[:3]
    return ("red", "green", "blue")[levels.index(max(levels))]


# A yellow pixel well inside the ball, in the picture's own pixels.
MIDDLE_OF_YELLOW = """(() => {
  const canvas = document.getElementById("picture");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const xs = [], ys = [];
  for (let at = 0; at < data.length; at += 4) {
    if (data[at] > 120 && data[at + 1] > 90 && data[at + 2] < 0.4 * data[at + 1]) {
      xs.push((at / 4) % canvas.width);
      ys.push(Math.floor(at / 4 / canvas.width));
    }
  }
  const middle = (values) => values.sort((a, b) => a - b)[Math.floor(values.length / 2)];
  return [middle(xs), middle(ys)];
})()"""


def drag(page: Browser, x1_px: int, y1_px: int, x2_px: int, y2_px: int) -> None:
    """Press at one place of the picture and let go at another."""
    area = page.run("(() => { const canvas = document.getElementById('picture'), area = canvas.getBoundingClientRect();"
                    "return [area.left, area.top, area.width / canvas.width]; })()")
    steps = (("mousePressed", x1_px, y1_px), ("mouseMoved", x2_px, y2_px), ("mouseReleased", x2_px, y2_px))
    for kind, x_px, y_px in steps:
        place = {"x": area[0] + (x_px + 0.5) * area[2], "y": area[1] + (y_px + 0.5) * area[2]}
        page._call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)
