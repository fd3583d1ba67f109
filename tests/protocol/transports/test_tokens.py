"""Keys of liveliness tokens: each token has one key, and only exact keys are tokens."""

import pytest

from sightline.protocol.transports.tokens import (
    RECALL_US,
    DetectorToken,
    DriverToken,
    RobotToken,
    SecondWatch,
    VisionToken,
    detectors_of,
    drivers_of,
    parse_token,
)

COMMITMENT = "0123456789abcdef" * 2
TOKENS = [
    (RobotToken("r1"), "sightline-token/robot/r1"),
    (VisionToken("lab-pc.2", 1.0, "0a1b2c3d"), "sightline-token/vision/lab-pc.2/1/0a1b2c3d"),
    (VisionToken("v", 0.25, "0a1b2c3d"), "sightline-token/vision/v/0.25/0a1b2c3d"),
    (VisionToken("v", 1000.0, "0a1b2c3d"), "sightline-token/vision/v/1000/0a1b2c3d"),
    (DriverToken("r1", "v", COMMITMENT), f"sightline-token/driver/r1/v/{COMMITMENT}"),
    (DetectorToken("0a1b2c3d", 2.5, "00000001", "r*-?"), "sightline-token/detector/0a1b2c3d/2.5/00000001/r+-="),
    (DetectorToken("0a1b2c3d", 1.0, "00000001"), "sightline-token/detector/0a1b2c3d/1/00000001/+"),
]
DETECTOR = "sightline-token/detector/0a1b2c3d/2.5/00000001/r+"



@pytest.mark.parametrize(("token", "key"), TOKENS)
def test_each_token_has_one_key(token, key):
    assert token.key == key
    assert parse_token(key) == token


@pytest.mark.parametrize("weight", [0.01, 0.125, 1.0, 3.5, 999.999, 1000.0, 123.457])
def test_a_weight_survives_its_key(weight):
    for token in (VisionToken("v", weight, "0a1b2c3d"), DetectorToken("0a1b2c3d", weight, "00000001")):
        assert parse_token(token.key) == token


@pytest.mark.parametrize("key", [
    "", "sightline-token", "sightline-token/robot", "sightline-token/robot/", "sightline-token/robot/*",
    "sightline-token/robot/r1/x", "sightline-token/robot/-r1", "sightline-token/robot/" + "r" * 33,
    "sightline-token/robot/r1\n", "sightline/robot/r1", "sightline-token/vision/v", "sightline-token/vision/v/1",
    "sightline-token/vision/v/0/0a1b2c3d", "sightline-token/vision/v/-1/0a1b2c3d",
    "sightline-token/vision/v/nan/0a1b2c3d", "sightline-token/vision/v/1e9/0a1b2c3d",
    "sightline-token/vision/v/1001/0a1b2c3d", "sightline-token/vision/v/0.001/0a1b2c3d",
    "sightline-token/vision/*/1/0a1b2c3d", "sightline-token/vision/a/b/1/0a1b2c3d",
    "sightline-token/vision/v/1/0A1B2C3D", "sightline-token/vision/v/1/0a1b2c3",
    f"sightline-token/driver/r1/v/{COMMITMENT[1:]}", f"sightline-token/driver/r1/*/{COMMITMENT}",
    f"sightline-token/driver/*/v/{COMMITMENT}", f"sightline-token/driver/r1/{COMMITMENT}",
    "sightline-token/vision/v/\u0661/0a1b2c3d", DETECTOR + "/x", DETECTOR + "*", DETECTOR + "r" * 32, DETECTOR[:-3],
    DETECTOR.replace("2.5", "\u0661"), DETECTOR.replace("2.5", "0"), DETECTOR.replace("2.5", "nan"),
    DETECTOR.replace("2.5", "1001"), DETECTOR.replace("2.5", "-1"), DETECTOR.replace("2.5", "*"),
    DETECTOR.replace("00000001", "*"), DETECTOR.replace("00000001", "0000000g"), DETECTOR.replace("00000001", ""),
    DETECTOR.replace("0a1b2c3d", "**"), DETECTOR.replace("0a1b2c3d", "0A1B2C3D"), DETECTOR.replace("r+", "a/b"),
])  # fmt: skip
def test_any_other_key_is_not_a_token(key):
    assert parse_token(key) is None


def test_pattern_of_the_drivers_of_a_robot():
    assert drivers_of("r1") == "sightline-token/driver/r1/*/*"


def test_pattern_of_the_detectors_of_a_group():
    assert detectors_of("0a1b2c3d") == "sightline-token/detector/0a1b2c3d/*/*/*"


def test_a_second_watch_counts_for_a_while_what_has_not_ended_and_stores_a_bounded_number_of_ends():
    watch, (first, second, third) = SecondWatch(1), map(RobotToken, "abc")
    assert watch.on_end(first) and not watch.is_on(0) and not watch.counts(second), "it has not begun"
    watch.begin(7)
    assert watch.on_end(second) and not watch.on_end(third)
    assert watch.is_on(6 + RECALL_US) and [*map(watch.counts, (first, second, third))] == [True, False, True]
    assert not watch.is_on(7 + RECALL_US) and not watch.counts(first)
