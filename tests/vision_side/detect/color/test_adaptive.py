"""The adaptive detector: goes along with the light, and loses the ball rather than jump to another."""

import cv2
import numpy as np
import pytest

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.color.adaptive import AdaptiveConfig, AdaptiveTracker, ColorModel, PixelTrack
from sightline.vision_side.detect.color.detectors import Adaptive
from sightline.vision_side.detect.color.hsv import HsvDetector
from sightline.vision_side.detect.port import NO_DEADLINE, Circle, DetectFrame
from tests.fixtures.vision.vision import speckle

YELLOW = (13, 199, 242)
FRAME_US = 33_333


def room(*balls: tuple[float, float, float], light: tuple[float, float, float] = (1, 1, 1), gain: float = 1.0,
         colour: tuple[int, int, int] = YELLOW, seed: int = 1, scale: int = 1) -> DecodedImage:
    """A grey room with balls (x, y, radius); `light` is the part of blue, green and red."""
    bgr = np.full((240, 320, 3), (140, 150, 155), np.float32)
    for x, y, radius in balls:
        cv2.circle(bgr, (round(x * 16), round(y * 16)), round(radius * 16), colour, -1, cv2.LINE_AA, 4)
    bgr = bgr * np.array(light, np.float32) * gain + speckle(bgr.shape, 2, seed)
    return DecodedImage(np.clip(bgr, 0, 255).astype(np.uint8), scale)


class Course:
    """Pictures one after the other."""

    def __init__(self, config: AdaptiveConfig | None = None) -> None:
        self.eye = AdaptiveTracker(config or AdaptiveConfig())
        self.t_us = 0

    def see(self, picture: DecodedImage):
        self.t_us += FRAME_US
        found = self.eye.detect(picture, self.t_us)
        return found[0].circle if found else None

    def acquire(self, x: float = 160, y: float = 120, radius: float = 20) -> Circle:
        seen = [self.see(room((x, y, radius), seed=seed)) for seed in range(4)]
        assert seen[:2] == [None, None], "it is not accepted at its first detection"
        assert seen[-1] is not None
        return seen[-1]


@pytest.mark.parametrize("scale", [1, 2])
def test_a_ball_is_found_where_it_is(scale: int) -> None:
    course = Course()
    for seed in range(5):
        circle = course.see(room((150.5, 110.25, 18), seed=seed, scale=scale))
    assert circle is not None
    true = (151 * scale, 110.75 * scale, 18 * scale)
    assert (circle.cx_px, circle.cy_px, circle.radius_px) == pytest.approx(true, abs=scale)


def test_adaptive_color_follows_the_light_beyond_the_ranges() -> None:
    course, seen, plain = Course(), 0, 0
    course.acquire()
    fixed = HsvDetector(HsvConfig())
    for step in range(120):
        part = min(1.0, step / 90)
        light = (1 + 0.35 * part, 1 - 0.05 * part, 1 - 0.45 * part)  # towards blue, as a shade does
        picture = room((160 + 0.5 * step, 120, 20), light=light, seed=step)
        circle = course.see(picture)
        seen += circle is not None and abs(circle.cx_px - 160.5 - 0.5 * step) < 2
        plain += bool(fixed.detect(picture))
    assert seen >= 115
    assert plain < 100, "the light leaves the configured ranges, or this tests nothing"


def test_missing_ball_is_not_replaced_by_another_object() -> None:
    course = Course()
    course.acquire(80, 120)
    for seed in range(12):  # 0.4 s: another ball of the same colour is in view all the time
        assert course.see(room((260, 120, 20), seed=seed)) is None


def test_nearer_of_two_objects_is_the_target() -> None:
    course = Course()
    course.acquire(100, 120)
    for step in range(30):
        circle = course.see(room((100 + step, 120, 20), (250, 110, 34), seed=step))
        assert circle is not None and circle.cx_px == pytest.approx(100.5 + step, abs=2)


def test_lost_target_is_found_again_elsewhere_after_a_while() -> None:
    course = Course()
    course.acquire(80, 120)
    found = [course.see(room((260, 120, 20), seed=seed)) for seed in range(30)]
    first = next(index for index, one in enumerate(found) if one is not None)
    assert 14 <= first <= 20, "half a second lost, then three pictures in a row"


def test_change_of_the_image_size_costs_no_more_than_a_new_start() -> None:
    config = AdaptiveConfig()
    eye, found = Adaptive(config), []
    for seq in range(1, 31):
        width, height = (320, 240) if seq <= 10 else (240, 180)
        picture = DecodedImage(cv2.resize(room((224, 120, 20), seed=seq).bgr, (width, height)), 1)
        header = FrameHeader(session="0000abcd", seq=seq, t_us=seq * FRAME_US)
        frame = DetectFrame("r1", header, b"", Decoder(width, height, 10**6), picture)
        (result,) = eye.detect([frame], NO_DEADLINE)
        found.append(bool(result and result.detections))
    assert found[9] and found[10:].count(False) <= config.confirm - 1


def test_detection_follows_the_fastest_turn() -> None:
    course = Course()
    course.acquire(30, 120)
    speed, x, seen = 0.0, 30.0, 0
    for step in range(22):
        speed = min(14.0, speed + 2.1)  # 2.5 rad/s, from rest at 10 rad/s^2, in pixels per picture
        x += speed
        circle = course.see(room((x, 120, 20), seed=step))
        seen += circle is not None and abs(circle.cx_px - x - 0.5) < 3
    assert seen == 22


@pytest.mark.parametrize("seed", range(3))
def test_no_image_makes_it_raise(seed: int) -> None:
    rng, course = np.random.default_rng(seed), Course(AdaptiveConfig(confirm=1))
    course.see(room((160, 120, 20)))
    for index in range(40):
        rows, columns = rng.integers(4, 200, 2).tolist()
        kind = index % 3
        bgr = rng.integers(0, 256, (rows, columns, 3), np.uint8) if kind else np.zeros((rows, columns, 3), np.uint8)
        if kind == 2:
            bgr[:] = YELLOW
        course.see(DecodedImage(bgr, 1))
        course.see(room((160, 120, 20)))


def test_color_is_independent_of_exposure_and_separates_yellow_from_orange() -> None:
    pixels = np.random.default_rng(1).normal(YELLOW, 3, (300, 3)).clip(0, 255).astype(np.uint8)
    chroma = ColorModel(pixels)
    assert chroma.distance((pixels * 0.35).astype(np.uint8)) < 2
    assert chroma.distance(np.full((50, 3), (20, 120, 240), np.uint8)) > 4
    assert chroma.distance(np.full((50, 3), (140, 150, 155), np.uint8)) > 4


def test_no_single_image_moves_the_color_far() -> None:
    yellow, blue = (np.full((300, 3), one, np.uint8) for one in (YELLOW, (220, 60, 30)))
    chroma = ColorModel(yellow)
    chroma.learn(blue, 1.0)
    assert chroma.distance(yellow) < 2


def test_the_gate_never_opens_on_the_whole_image() -> None:
    track = PixelTrack(Circle(160, 120, 20), 320)
    for _ in range(60):
        track.advance(0.0333)
    assert track.gate_px <= 1.5 * 20 + 0.06 * 320
    assert not track.admits(Circle(160, 120, 40)), "as large as that it is another"
