"""Color ranges are written into a configuration of vision: all comments and values stay, or nothing changes."""

import json
import os
import re
import stat
import tomllib
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from sightline.operator_side.calibrate.color_file import check_config, ranges_toml, with_ranges, write_ranges
from sightline.operator_side.cli.app import run
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.recording.film import Film
from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import HsvRange
from tests.fixtures.commands import sightline
from tests.operator_side.calibrate.test_color import ball_picture

YELLOW = (HsvRange(hue_low_deg=41, hue_high_deg=57, saturation_low=0.42, value_low=0.4),)
RED = (HsvRange(hue_low_deg=352, hue_high_deg=360), HsvRange(hue_low_deg=0, hue_high_deg=11))
FILES = {
    "empty": "",
    "without": "# my robot\nrobot = 'r1'  # the small one\n",
    "no line end": "robot = 'r1'",
    "table": "[hsv]  # colour\n# shape of it\nshape = 'any'\n\n[target]\nradius_m = 0.05 # small\n",
    "list": "[hsv]\nranges = [{hue_low_deg = 1, hue_high_deg = 2}] # old\n[target]\nradius_m = 0.05\n",
    "long list": "[hsv]\nranges = [ # first\n  # second ]\n  {hue_low_deg = 1,  hue_high_deg = 2}, # third\n]# fourth\n"
                 "shape='any'",
    "blocks": "robot='r1'\n[[hsv.ranges]]\n# yellow\nhue_low_deg = 1 # low\nhue_high_deg = 2\n\n[[hsv.ranges]]\n"
              "hue_low_deg = 3\nhue_high_deg = 4\n# end\n[target] # t\nradius_m = 0.05\n",
    "dotted": "hsv.shape = 'any'\nhsv.ranges = [{hue_low_deg=1,hue_high_deg=2}]  # old\n[target]\nradius_m = 0.05\n",
    "subtable first": "[missions.goto]\na = 1\n[hsv]\nmax_contours = 4\n",
    "strings": "connect = ['tcp/[::1]:7447', \"tcp/a#b:1\"]\n[hsv]\nshape = \"\"\"any\"\"\" # ] [hsv]\n",
    "crlf": "# one\r\n[hsv]\r\nshape = 'any' # two\r\n",
}


COMMENTS = ("# my robot", "# the small one", "# colour", "# shape of it", "# small", "# old", "# first", "# second ]",
            "# third", "# fourth", "# yellow", "# low", "# end", "# t", "# ] [hsv]", "# one", "# two")


def comments(text):
    return [part for part in COMMENTS if part in text]


@pytest.mark.parametrize("ranges", [YELLOW, RED], ids=["one", "two"])
@pytest.mark.parametrize("name", FILES)
def test_only_the_ranges_change_and_no_comment_is_lost(name, ranges):
    before = FILES[name]
    after = with_ranges(before, ranges)
    read, was = tomllib.loads(after), tomllib.loads(before)
    assert read["hsv"].pop("ranges") == tomllib.loads(f"r = {ranges_toml(ranges)}")["r"]
    was.get("hsv", {}).pop("ranges", None)
    assert {key: value for key, value in read.items() if value} == {key: value for key, value in was.items() if value}
    assert comments(after) == comments(before)
    assert after.endswith("\n")
    again = with_ranges(after, ranges)
    assert tomllib.loads(again) == tomllib.loads(after)


@pytest.mark.parametrize("ranges", [YELLOW, RED], ids=["one", "two"])
def test_the_configuration_of_the_car_keeps_its_layout(ranges):
    before = (Path(__file__).parents[3] / "examples/raspberry-car-vision.toml").read_text()
    start, end = before.index("[[hsv.ranges]]"), before.index("\n[steer]")
    after = with_ranges(before, ranges)
    assert after.startswith(before[:start]) and after.endswith(f"value_low = {ranges[-1].value_low}\n{before[end:]}")


@pytest.mark.parametrize(("text", "words"), [
    ("hsv = {shape = 'any'}\n", "insert by hand: ranges = [ { hue_low_deg = 41"),
    ("hsv = 3\n", "insert by hand"),
    ("x = [\n", "invalid TOML"),
])
def test_file_that_cannot_be_changed_safely_stays_unchanged(text, words, tmp_path):
    file = tmp_path / "vision.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words.replace("[", r"\[")) as why:
        write_ranges(file, YELLOW)
    assert file.read_text() == text and "\n" not in str(why.value) and str(file) in str(why.value)
    assert [one.name for one in tmp_path.iterdir()] == ["vision.toml"]


def test_vision_reads_the_written_ranges(tmp_path):
    file = tmp_path / "vision.toml"
    write_ranges(file, YELLOW)
    file.chmod(0o640)
    write_ranges(file, RED)
    config = load_service("vision", file=str(file), environ={}).config
    assert [(one.hue_low_deg, one.hue_high_deg) for one in config.hsv.ranges] == [(352, 360), (0, 11)]
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    (tmp_path / "bad.toml").write_text("hvs = 1\n")
    with pytest.raises(ConfigError, match="unknown key"):
        check_config(tmp_path / "bad.toml")
    with pytest.raises(ConfigError, match="no folder"):
        check_config(tmp_path / "none" / "vision.toml")


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/null")])
def test_pipe_device_or_folder_is_not_a_configuration_to_write(make, tmp_path):
    """A pipe without a writer would block the command; a device would be replaced by the file."""
    make(tmp_path / "vision.toml")
    with pytest.raises(ConfigError, match=r"vision\.toml: it is not a regular file; choose another file"):
        check_config(tmp_path / "vision.toml")


@pytest.mark.parametrize("before", ["", "robot = 'r1'", "robot = 'r1'\n", "robot = 'r1'\r\n[hsv]\n"])
def test_file_whose_line_ends_are_not_those_of_windows_gets_none_of_them(tmp_path, before):
    (tmp_path / "vision.toml").write_bytes(before.encode())
    write_ranges(tmp_path / "vision.toml", YELLOW)
    assert (tmp_path / "vision.toml").read_bytes().count(b"\r") == before.count("\r")


def test_link_to_the_file_and_its_line_ends_stay(tmp_path):
    file, link = tmp_path / "shared.toml", tmp_path / "vision.toml"
    link.symlink_to(file.name)
    before = b"\xef\xbb\xbf# mine\r\n[hsv]\r\nshape = 'any'\r\n\r\n[target]\r\nradius_m = 0.05\r\n"
    file.write_bytes(before)
    write_ranges(link, YELLOW)
    after = file.read_bytes()
    assert link.is_symlink() and sorted(tmp_path.iterdir()) == [file, link]
    assert after.count(b"\n") == after.count(b"\r\n") > before.count(b"\n")
    assert [line for line in before.split(b"\r\n") if line not in after.split(b"\r\n")] == []


# --- the command, without a browser --------------------------------------------------------------------------------


@pytest.fixture
def there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("ball.png", ball_picture(210))
    cv2.imwrite("wall.png", np.full((60, 80, 3), (30, 200, 40), np.uint8))
    return tmp_path


def test_click_in_an_image_gives_range_mask_and_configuration(there, capsys):
    (there / "vision.toml").write_text("# mine\n[hsv]\nshape = 'any' # all\n")
    assert run(["pick-color", "--image", "ball.png", "--at", "110,112", "--config", "vision.toml", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert 200 <= said["ranges"][0]["hue_low_deg"] <= 205 and said["trial"]["most_blobs"] == 1
    assert said["written"] == "vision.toml" and cv2.imread(said["mask"]).shape == (240, 640, 3)
    text = (there / "vision.toml").read_text()
    assert "# mine" in text and "# all" in text and "hue_low_deg = 20" in text


def test_range_is_tested_over_the_whole_video(there, capsys):
    with Film(there / "run.mp4", 10) as film:
        for number in range(12):
            film.add(ball_picture(210, 1.0, 0.2 - number * 0.02, seed=number), number * 100_000)
    with av.open("run.mp4") as film:
        assert sum(1 for _ in film.decode(video=0)) == 12
    assert run(["pick-color", "--video", "run.mp4", "--box", "140,90,40,40", "--frames", "5", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["trial"]["pictures"] == 5 and said["trial"]["with_any"] == 5 and said["written"] is None


@pytest.mark.usefixtures("there")
def test_libraries_print_nothing_about_an_invalid_video():
    Path("film.mp4").write_bytes(b"no film at all" * 100)
    done = sightline("pick-color", "--video", "film.mp4", "--at", "1,1")
    assert (done.returncode, done.stderr) == (2, "error: invalid video film.mp4; use another file\n")


@pytest.mark.parametrize(("arguments", "words"), [
    ("--image ball.png --at 10,10", "no color at 10,10: it is gray"),
    ("--image ball.png --at 400,10", "400,10 is outside the image of 320x240"),
    ("--image wall.png --at 10,10", "marks 100% of an image"),
    ("--picture ball.png --at 10,10", "no color at 10,10: it is gray"),  # the former name
    ("--image ball.png --at 1", "expected X,Y"),
    ("--image ball.png --at -1,5", "expected X,Y"),
    ("--image ball.png --at 1,٣", "expected X,Y"),
    ("--image ball.png --box 1,2,3", "expected X,Y,W,H"),
    ("--image ball.png --box 1,2,0,3", "expected X,Y"),
    ("--image ball.png --box 1,2,00,3", "expected X,Y"),
    ("--image ball.png --at 1,1 --box 1,1,2,2", "exclude each other"),
    ("r1 --image ball.png --at 1,1", "ROBOT and --image exclude each other"),
    ("--image none.png --at 1,1", "cannot read none.png: No such file"),
    ("--image vision.toml --at 1,1", "invalid image vision.toml"),
    ("--image /dev/zero --at 1,1", "/dev/zero is not a file; name a PNG or JPEG"),
    ("--image tiny.png --at 0,0", "tiny.png has 20x2, at least 16 pixels a side"),
    ("--video none.mp4 --at 1,1", "is not a file; name a video"),
    ("--video vision.toml --at 1,1", "invalid video vision.toml"),
    ("--image ball.png --json", "add --at X,Y"),
    ("--image ball.png --at 110,112 --config bad.toml", "bad.toml"),
    ("--image ball.png --at 110,112 --mask none/mask.png", "cannot write none/mask.png"),
    ("--image ball.png --at 110,112 --mask ./ball.png", "--mask ball.png is also the file of --image"),
    ("--image ball.png --at 110,112 --mask mask.jpg", "invalid --mask mask.jpg: expected a .png file"),
    ("--at 1,1 --connect nowhere", "nowhere"),
])
def test_failed_pick_is_one_line_and_writes_nothing(there, capsys, arguments, words):
    (there / "vision.toml").write_text("")
    (there / "bad.toml").write_text("hvs = 1\n")
    cv2.imwrite("tiny.png", np.full((2, 20, 3), (30, 200, 40), np.uint8))
    before = {one.name: one.read_bytes() for one in there.iterdir()}
    assert run(["pick-color", *arguments.split()]) == 2
    said = capsys.readouterr()
    assert words in said.err and said.err.count("\n") == 1 and said.err.startswith("error: ")
    after = {one.name: one.read_bytes() for one in there.iterdir() if one.name != "pick-color-mask.png"}
    assert after == before


def test_loop_of_symbolic_links_is_one_line(there, capsys):
    (there / "loop").symlink_to("loop")
    assert run(["pick-color", "--image", "loop", "--at", "1,1"]) == 2
    assert re.fullmatch("error: .*loop: Too many levels of symbolic links; .*\n", capsys.readouterr().err)
