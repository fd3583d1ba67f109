"""Test the JavaScript viewer in a browser, with a simulated Sightline robot and with the JavaScript robot."""

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from sightline.evaluation.processes import SIGHTLINE
from tests.fixtures.javascript import Browser, JsProcess, JsRobot, chromium, node
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_port

# Brightness of the canvas at a grid of points: an image has several levels, an empty canvas one.
LEVELS = """(() => {
  const canvas = document.getElementById("picture");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const found = new Set();
  for (let at = 0; at < data.length; at += 4 * 997) found.add(data[at + 1] >> 4);
  return [canvas.width, canvas.height, found.size];
})()"""

WINDOWS = ((760, 1000), (320, 560), (844, 390), (1366, 650))
"""Width and height of windows: the default of `Browser`, a phone upright and on its side, a laptop."""


def place(page: Browser, part: str, width: int, height: int) -> list[float]:
    """Return (top, bottom, left, right) of an element in a window of this size, by its id."""
    page._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=True)
    box = f"document.getElementById({part!r}).getBoundingClientRect()"
    return list(page.run(f"(({{ top, bottom, left, right }}) => [top, bottom, left, right])({box})"))


class Started:
    """Run a `sightline` command until the end of the block: `with Started(folder, "sim", "--seed", "3") as sim`."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self._command = [*SIGHTLINE, *arguments]
        self._log = (folder / f"{arguments[0]}.log").open("a+")

    def __enter__(self) -> "Started":
        self.process = subprocess.Popen(self._command, stdout=self._log, stderr=subprocess.STDOUT)
        return self

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        self.process.wait(10)
        self._log.close()

    def says(self, pattern: str, seconds: float = START_S) -> bool:
        """Return whether the command prints a line that matches `pattern` in time."""
        return until(lambda: re.search(pattern, Path(self._log.name).read_text()), seconds)


@pytest.fixture
def our_viewer(tmp_path: Path) -> Iterator[tuple[Browser, Started]]:
    """Yield the page of a simulated Sightline robot behind the gateway, and the robot."""
    chromium(), node()
    sockets, port, page_port = f"/tmp/sl-{os.getpid()}-{free_port()}", free_port(), free_port()
    device = f'{{kind = "sim", options = {{socket_dir = "{sockets}"}}}}'
    (tmp_path / "robot.toml").write_text(
        f'listen = ["ws://127.0.0.1:{port}"]\nstate_dir = "{tmp_path}/state"\ncamera = {device}\ndrive = {device}\n'
    )
    with ExitStack() as ending:
        sim = ending.enter_context(
            Started(tmp_path, "sim", "--scenario", "static", "--seed", "11", "--socket-dir", sockets)
        )
        assert sim.says("simulation ready")
        robot = ending.enter_context(Started(tmp_path, "robot", "--config", str(tmp_path / "robot.toml")))
        assert robot.says(rf"ws://127.0.0.1:{port}")
        gateway = ("gateway.mjs", "--connect", f"ws://127.0.0.1:{port}", "--robot", "r1", "--port", str(page_port))
        assert ending.enter_context(JsProcess(tmp_path, *gateway)).says("viewer of robot r1")
        yield ending.enter_context(Browser(tmp_path, f"http://127.0.0.1:{page_port}/")), robot


def answered(page: Browser) -> int:
    """Return the number of frames that the page reports as drawn and answered."""
    found = re.search(r"(\d+) answered by this page", page.text("frames"))
    return int(found[1]) if found else 0


def is_drawn(page: Browser) -> bool:
    """Return whether the canvas shows an image of some size, in more than one color."""
    width, _height, levels = page.run(LEVELS)
    return bool(width >= 160 and levels >= 4)


def is_armed(page: Browser) -> bool:
    """Return whether the robot drives; if not, request it, as an operator does until it is permitted."""
    driving = page.text("state") == "ACTIVE"
    if not driving:
        page.click("arm")
    return driving


def is_moving(page: Browser) -> bool:
    """Return whether the page shows wheels that turn."""
    return re.search("^-?0.00 m/s.* 0.00 rad/s", page.text("wheels")) is None


@pytest.mark.slow
def test_a_browser_watches_steers_and_stops_our_robot(tmp_path: Path, our_viewer: tuple[Browser, Started]) -> None:
    page, robot = our_viewer
    assert until(lambda: page.text("link") == "connected", START_S), page.text("link")
    assert until(lambda: is_drawn(page), START_S), page.text("age")
    assert until(lambda: answered(page) > 30, START_S), page.text("frames")
    assert re.fullmatch(r"\d+ images/s, at least \d+ ms old", page.text("age"))
    # The page only watches until a request to drive.
    assert page.text("driver") == "none"

    page.click("drive")
    assert until(lambda: page.text("driver") == "this page", START_S), page.text("driver")
    assert until(lambda: is_armed(page), START_S), page.text("message")
    assert until(lambda: is_moving(page), START_S), page.text("reason")
    assert re.fullmatch(r"\d+ ms old, capture to command \d+ ms", page.text("frame_age"))
    page.screenshot(tmp_path / "driving.png")
    assert (tmp_path / "driving.png").stat().st_size > 10_000

    page.press("Space", " ")
    assert until(lambda: page.text("state") == "STOPPED", 3.0), page.text("message")
    assert page.run("document.getElementById('drive').checked") is True  # the space bar did not press a button
    assert robot.says(r"STOPPED \(STOP by operator\)")
    assert page.errors == []


@pytest.mark.slow
def test_page_reports_a_lost_robot_and_finds_it_again(tmp_path: Path) -> None:
    port = free_port()
    with JsRobot(tmp_path, port=port) as robot, Browser(tmp_path, f"http://127.0.0.1:{port}/") as page:
        assert until(lambda: answered(page) > 10, START_S), page.text("frames")
        robot.kill()
        assert until(lambda: page.text("age").startswith("no image for"), 5.0), page.text("age")
        assert until(lambda: page.text("link").startswith("no connection"), 5.0), page.text("link")
        assert page.run("document.getElementById('figure').className") == "old"
        assert page.text("state") == page.text("wheels") == "?"
        with JsRobot(tmp_path, port=port):
            assert until(lambda: page.text("link") == "connected", 8.0), page.text("link")
            assert until(lambda: page.text("age").endswith("ms old"), 8.0), page.text("age")
        assert page.errors == []


@pytest.mark.slow
def test_page_connects_with_the_token_after_the_hash(tmp_path: Path) -> None:
    (tmp_path / "token").write_text("0123456789abcdef")
    with JsRobot(tmp_path, "--token-file", str(tmp_path / "token")) as robot:
        address = f"http://127.0.0.1:{robot.port}/"
        with Browser(tmp_path, address + "#0123456789abcdef") as page:
            assert until(lambda: is_drawn(page), START_S), page.text("link")
        other = tmp_path / "other"
        other.mkdir()
        with Browser(other, address) as page:
            assert until(lambda: page.text("link").startswith("no connection"), START_S), page.text("link")
            assert answered(page) == 0


@pytest.mark.slow
@pytest.mark.parametrize("size", [(640, 480), (480, 640), (16, 4000), (4000, 16)])
def test_stop_button_is_visible_below_an_image_of_any_shape(tmp_path: Path, size: tuple[int, int]) -> None:
    port = free_port()
    with JsRobot(tmp_path, port=port) as robot, Browser(tmp_path, f"http://127.0.0.1:{port}/") as page:
        assert until(lambda: answered(page) > 0, START_S), page.text("frames")
        robot.kill()  # no later image changes the size
        assert until(lambda: page.text("link").startswith("no connection"), 5.0), page.text("link")
        page.run("Object.assign(document.getElementById('picture'), {{ width: {}, height: {} }}) && 0".format(*size))
        for window in WINDOWS:
            top, bottom, left, right = place(page, "stop", *window)
            assert 0 < top < bottom <= window[1] and 0 <= left < right <= window[0], (window, bottom)
