"""Waypoints and options of a mission request, and its reports as text."""

from pathlib import Path

import pytest

from sightline.operator_side.cli import operate
from sightline.operator_side.client.missions import (
    MissionClient,
    cannot,
    mission_line,
    mission_lines,
    request_of,
    waypoints_of,
    waypoints_of_file,
)
from sightline.operator_side.config.toml_text import options_of
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.messages import MissionReport
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore


def test_waypoints_are_pairs_of_meters():
    assert waypoints_of(["1.5", "-2", "+.5", "1e1"]) == ((1.5, -2.0), (0.5, 10.0))
    assert waypoints_of(["100", "-100"]) == ((100.0, -100.0),)
    text = "# out\n1.5 1.5\n\n 0,-2.25   # and back\n-1 , 3\n"
    assert waypoints_of_file(text, "way.txt") == ((1.5, 1.5), (0.0, -2.25), (-1.0, 3.0))


@pytest.mark.parametrize(("texts", "words"), [
    (["1", "2", "abc", "4"], "waypoint 2: invalid number 'abc'; write X Y in meters, e.g. 1.5 -0.5"),
    (["1", "nan"], "waypoint 1: invalid number 'nan'"),
    (["inf", "1"], "waypoint 1: invalid number 'inf'"),
    (["1_0", "1"], "waypoint 1: invalid number '1_0'"),
    (["٣", "1"], "invalid number"),
    (["1", "2", "--wiat"], "waypoint 2: invalid number '--wiat'; `sightline goto --help` lists the options"),
    (["1", "2", "3"], "waypoint 2: has an X and no Y"),
    (["1", "100.5"], "waypoint 1: 100.5 m is out of range; expected -100 to 100 m"),
    (["1e999", "1"], "out of range"),
    ([], "0 waypoints; expected 1 to 64"),
    (["1", "1"] * 65, "65 waypoints; expected 1 to 64"),
])
def test_invalid_waypoint_is_named(texts, words):
    with pytest.raises(ConfigError) as error:
        waypoints_of(texts)
    assert words in str(error.value) and len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(("text", "words"), [
    ("1 2\n1 2 3\n", "way.txt:2: has 3 numbers"),
    ("1 2\n1 b\n", "way.txt:2: invalid number 'b'"),
    ("# nothing\n", "way.txt: 0 waypoints; expected 1 to 64, one X Y per line"),
    ("1 500\n", "way.txt:1: 500 m is out of range"),
])
def test_a_file_of_waypoints_names_its_line(text, words):
    with pytest.raises(ConfigError, match=words.replace("(", r"\(")):
        waypoints_of_file(text, "way.txt")


@pytest.mark.parametrize(("content", "found"), [
    (b"\xef\xbb\xbf1.5 2\r\n", ((1.5, 2.0),)), (b"1 2\n#" + b" " * 999_995, ((1.0, 2.0),)),
    (b"1 2\n#" + b" " * 999_996, "cannot read .*way.txt: more than 1000000 bytes; name a file of waypoints"),
    (b"\xff\xfe1 2", "cannot read .*way.txt: not a text file; name a file with one waypoint X Y per line"),
])
def test_file_of_waypoints_is_text_of_a_bounded_size(tmp_path, content, found):
    (file := tmp_path / "way.txt").write_bytes(content)
    if isinstance(found, tuple):
        assert operate._waypoints([], file) == found
    else:
        with pytest.raises(ConfigError, match=found):
            operate._waypoints([], file)


def test_endless_file_of_waypoints_is_rejected():
    with pytest.raises(ConfigError, match="cannot read /dev/zero: more than 1000000 bytes"):
        operate._waypoints([], Path("/dev/zero"))


def test_options_are_read_as_toml_values():
    assert options_of(["a=1", "b.c=0.5", "d=true", "e=left", 'f="2"', "g="]) == {
        "a": 1, "b.c": 0.5, "d": True, "e": "left", "f": "2", "g": ""}
    for wrong in ("a", "=1"):
        with pytest.raises(ConfigError, match="invalid --set"):
            options_of([wrong])


@pytest.mark.parametrize(("name", "options", "words"), [
    ("my_missions:Circle", {}, "invalid mission"),
    ("Follow", {}, "invalid mission"),
    ("band", {"a": [1]}, "option 'a'"),
    ("band", {"a": float("nan")}, "option 'a'"),
    ("band", {"A": 1}, "option"),
    ("band", {f"o{at}": 1 for at in range(17)}, "at most 16 options"),
])
def test_request_that_the_protocol_does_not_permit_is_rejected(name, options, words):
    with pytest.raises(ConfigError, match=words):
        request_of(1, name, (), options)


@pytest.mark.parametrize("wrong", [[(float("nan"), 1.0)], [(1e9, 0.0)], (1, 2), [(1.0,)], [(0.0, 0.0)] * 65])
def test_waypoints_that_the_protocol_does_not_permit_are_named(wrong):
    with pytest.raises(ConfigError, match=r"invalid waypoints: expected at most 64 pairs \(x, y\), each number -"):
        request_of(1, "goto", wrong, {})


def test_silence_names_the_side_that_is_silent():
    """`sightline mission follow` names a robot 'follow'. Before, it advised to run a vision service."""
    network = MemoryNetwork()
    missions = MissionClient(network.link("r1", role="operator"))
    with pytest.raises(LinkError, match="no status from robot 'r1' after 3 s; run `sightline robots`"):
        missions.report(0.0)
    driving = DriverCore(RobotConfig(drive=PluginChoice(kind="log"), camera=PluginChoice(kind="folder")), "0000000a")
    now_us = network.now_us + 1_000_000
    driving.tick(now_us, None, None)
    for message in driving.messages(now_us):
        network.link("r1").publish(message.channel, message.header, message.payload)
    network.advance(now_us)
    with pytest.raises(LinkError, match="no report from a vision service of robot 'r1' after 3 s; run `sightline vis"):
        missions.report(0.0)


def test_report_is_formatted_as_text():
    report = MissionReport(mission="goto", phase="driving", note="reached 1 of 2", detector="hsv", device="cpu")
    assert mission_line(report) == "goto: driving; reached 1 of 2" and not cannot(report)
    over = report.model_copy(update={"phase": "cannot reach", "done": True, "refused": "unknown mission 'x'",
                                     "inference_us": 1060})
    assert list(mission_lines(over)) == [
        "mission   goto: cannot reach; reached 1 of 2 (over)",
        "          last mission request rejected: unknown mission 'x'",
        "detector  hsv, on cpu, 1.1 ms per image",
    ]
    assert cannot(over) and not cannot(over.model_copy(update={"phase": "arrived"}))
