"""The images of the page of `pick-color`: what it shows can be picked, and the newest ones test the range."""

import json

import pytest

from sightline.operator_side.calibrate.color_page import LiveGallery, PickPage
from sightline.operator_side.client.pictures import Shot
from sightline.protocol.channels import FRAME
from sightline.protocol.errors import ConfigError
from tests.fixtures.vision.vision import jpeg_of
from tests.operator_side.calibrate.test_color import BALL, ball_picture

BALL_JPEG = jpeg_of(ball_picture(50))


def gallery_of(frames: int, shots: int) -> LiveGallery:
    gallery = LiveGallery(frames)
    for at in range(1, shots + 1):
        gallery.buffer.add(Shot(FRAME, BALL_JPEG, "0000000a", at, at * 100_000, 320, 240))
    return gallery


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_shown_image_can_be_picked_after_the_next_one_arrived(frames):
    page = PickPage(gallery_of(frames, shots=4), "robot r1", lambda _ranges: "")
    picked = {"number": 3, "x_px": BALL.x_px, "y_px": BALL.y_px, "width_px": 0, "height_px": 0}
    answer = json.loads(page.routes["POST /pick"]({}, json.dumps(picked).encode()).body)
    assert "error" not in answer and answer["pictures"] == frames


def test_image_that_left_the_buffer_is_reported():
    with pytest.raises(ConfigError, match="that image is gone; pick in a newer one"):
        gallery_of(1, shots=4).pixels(2)


def test_only_the_range_that_the_page_shows_is_used():
    used = []
    page = PickPage(gallery_of(1, shots=1), "robot r1", lambda ranges: used.append(ranges) or "saved")
    picked = {"number": 1, "x_px": BALL.x_px, "y_px": BALL.y_px, "width_px": 0, "height_px": 0}
    shown = json.loads(page.routes["POST /pick"]({}, json.dumps(picked).encode()).body)
    other = json.dumps({"toml": "ranges = [[1, 2, 3, 4, 5, 6]]"}).encode()  # of a second page, which picked before
    with pytest.raises(ConfigError, match="another page has picked since; pick again"):
        page.routes["POST /use"]({}, other)
    assert not used and not page.done.is_set()
    answer = page.routes["POST /use"]({}, json.dumps({"toml": shown["toml"]}).encode())
    assert json.loads(answer.body) == {"note": "saved"}
    assert len(used) == 1 and page.done.is_set()
