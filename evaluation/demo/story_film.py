"""Draws the story: a chase camera next to the robot's view, an age bar, states and figures. Shell (writes a file).

The chase camera is a second renderer. It draws after the run from the recorded truth, so it costs the run nothing.
`write_story` writes an animated WebP with Pillow: libwebp has a BSD license, so no GPL codec is needed.
"""

import io
import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.evaluation.demo.story import (
    LIMITS,
    FilmScene,
    FilmShot,
    Story,
    Take,
    Tone,
    closing_lines,
    scenes,
    shot,
)
from sightline.operator_side.preflight import needs
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import CameraModel
from sightline.sim.robot import RobotModel
from sightline.sim.scenario import Place, Scenario
from sightline.sim.truth import Truth
from sightline.sim.world.bodies import ThingBodies
from sightline.sim.world.camera import TEXELS_PER_M, TILE_TEXELS, SceneCamera
from sightline.sim.world.engine import pybullet
from sightline.sim.world.physics import Vector, open_client

if TYPE_CHECKING:
    from PIL import Image as Pillow
    from PIL import ImageDraw, ImageFont

Pixels = NDArray[np.uint8]
Color = tuple[int, int, int]

# --- the chase camera ------------------------------------------------------------------------------------------------

_STEP_US: Final = 4000
_BACK_M, _UP_M, _DOWN_RAD = 0.82, 0.54, math.radians(27)
_FOLLOW_S: Final = 0.45
"""Time constant of the turning chase camera. A view that turns as fast as the robot is hard to watch."""
_LEVEL: Final = (0.0, 0.0, 0.0, 1.0)
_DARK, _DECK, _PLATE, _LENS = (0.10, 0.10, 0.12), (0.13, 0.30, 0.62), (0.20, 0.45, 0.85), (0.92, 0.94, 0.96)
_ORIGIN: Final = (0.0, 0.0, 0.0)


class Piece(NamedTuple):
    """One box or cylinder of the drawn robot, relative to the midpoint of its axle on the floor."""

    body: int
    at_m: Vector
    turn: Any


class ChaseCamera:
    """Draws a recorded scene from behind and above the robot. Use it as a context manager."""

    def __init__(self, scenario: Scenario, robot: RobotModel, width_px: int, height_px: int) -> None:
        self._client = open_client(_STEP_US)
        self._pieces = _drawn_robot(self._client, robot)
        nowhere = Place(0.0, 0.0, 0.0)
        self._target = ThingBodies(self._client, scenario.target, nowhere, is_target=True)
        focal_px = width_px / 2 / math.tan(math.radians(62) / 2)
        lens = CameraModel(width_px=width_px, height_px=height_px, fx_px=focal_px, fy_px=focal_px,
                           cx_px=width_px / 2, cy_px=height_px / 2)
        self._camera = SceneCamera(self._client, lens, scenario.walls, 0, checkered_tile())
        self._yaw_rad: float | None = None
        self._t_us = 0

    def draw(self, truth: Truth) -> Pixels:
        """Return the RGB image at `truth`. The camera turns smoothly from call to call."""
        self._follow(truth)
        turn = pybullet.getQuaternionFromEuler([0, 0, truth.yaw_rad])
        for piece in self._pieces:
            at = pybullet.multiplyTransforms((truth.x_m, truth.y_m, 0.0), turn, piece.at_m, piece.turn)
            pybullet.resetBasePositionAndOrientation(piece.body, *at, physicsClientId=self._client)
        self._target.put(Place(truth.target_x_m, truth.target_y_m, 0.0), 0.0)
        yaw_rad = self._yaw_rad or 0.0
        lens = (truth.x_m - _BACK_M * math.cos(yaw_rad), truth.y_m - _BACK_M * math.sin(yaw_rad), _UP_M)
        return self._camera.draw(lens, pybullet.getQuaternionFromEuler([0, _DOWN_RAD, yaw_rad]))

    def _follow(self, truth: Truth) -> None:
        if self._yaw_rad is None or not 0 <= truth.t_us - self._t_us < 1_000_000:
            self._yaw_rad = truth.yaw_rad
        else:
            share = 1 - math.exp(-(truth.t_us - self._t_us) / 1e6 / _FOLLOW_S)
            self._yaw_rad += share * math.remainder(truth.yaw_rad - self._yaw_rad, math.tau)
        self._t_us = truth.t_us

    def close(self) -> None:
        """Free the memory of PyBullet."""
        pybullet.disconnect(self._client)


def checkered_tile() -> Pixels:
    """Return gray squares of 0.5 m: they show motion and compress well."""
    squares = np.arange(TILE_TEXELS) // (TEXELS_PER_M // 2) % 2
    value = np.where(squares[:, None] == squares[None, :], 138, 154)
    return np.repeat(value[..., None], 3, axis=2).astype(np.uint8)


def _drawn_robot(client: int, robot: RobotModel) -> list[Piece]:
    """Add plate, deck, camera and wheels in colors, which the physics lacks."""
    wheels, camera = robot.wheels, robot.camera
    across = pybullet.getQuaternionFromEuler([math.pi / 2, 0, 0])
    boxes = [((0.16, 0.15, 0.012), (-0.02, 0.0, 0.042), _PLATE), ((0.10, 0.11, 0.035), (-0.035, 0.0, 0.068), _DECK),
             ((0.02, 0.05, 0.05), (camera.x_m - 0.005, 0.0, camera.z_m + 0.01), _LENS)]
    pieces = [Piece(_box(client, size, color), at, _LEVEL) for size, at, color in boxes]
    for side in (1, -1):
        visual = pybullet.createVisualShape(
            pybullet.GEOM_CYLINDER, radius=wheels.radius_m, length=0.022, rgbaColor=[*_DARK, 1],
            specularColor=[0, 0, 0], physicsClientId=client)
        body = int(pybullet.createMultiBody(0, -1, visual, _ORIGIN, _LEVEL, physicsClientId=client))
        pieces.append(Piece(body, (0.0, side * wheels.track_m / 2, wheels.radius_m), across))
    return pieces


def _box(client: int, size_m: Vector, color: tuple[float, float, float]) -> int:
    visual = pybullet.createVisualShape(
        pybullet.GEOM_BOX, halfExtents=[side / 2 for side in size_m], rgbaColor=[*color, 1], specularColor=[0, 0, 0],
        physicsClientId=client)
    return int(pybullet.createMultiBody(0, -1, visual, _ORIGIN, _LEVEL, physicsClientId=client))


# --- one image -------------------------------------------------------------------------------------------------------

WIDTH_PX: Final = 720
VIEW_PX: Final = (356, 267)
_GAP_PX, _TOP_PX, _BAR_PX, _CAPTION_PX = 8, 40, 50, 46
HEIGHT_PX: Final = _TOP_PX + VIEW_PX[1] + _BAR_PX + _CAPTION_PX
_INK, _PALE, _BACK = (236, 239, 244), (150, 158, 170), (22, 25, 31)
GREEN, YELLOW, RED, GRAY = (46, 160, 67), (190, 138, 0), (215, 58, 50), (90, 98, 110)
_TONES: Final[dict[Tone, Color]] = {"calm": (44, 50, 62), "lost": (150, 96, 0), "safe": GREEN, "bad": RED}
_STATES: Final = {"ACTIVE": GREEN, "DEGRADED": YELLOW, "HOLD": YELLOW, "STOPPED": RED, "DISARMED": GRAY,
                  "no gate": GRAY}
_BAR_MS: Final = 800.0
"""Frame age at the right end of the bar."""


def age_color(age_us: int | None) -> Color:
    """Return green up to the full-speed age of the robot, yellow up to its zero-speed age, else red."""
    if age_us is None or age_us > LIMITS.zero_speed_age_ms * 1000:
        return RED
    return GREEN if age_us <= LIMITS.full_speed_age_ms * 1000 else YELLOW


class Fonts:
    """The DejaVu Sans fonts of Matplotlib."""

    def __init__(self) -> None:
        with needs("report"):
            from matplotlib import get_data_path
            from PIL import ImageFont
        folder = Path(get_data_path()) / "fonts" / "ttf"
        self._load, self._folder = ImageFont.truetype, folder
        self.small, self.plain = self._font("DejaVuSans", 14), self._font("DejaVuSans", 16)
        self.bold, self.large = self._font("DejaVuSans-Bold", 16), self._font("DejaVuSans-Bold", 20)

    def _font(self, name: str, size_px: int) -> "ImageFont.FreeTypeFont":
        return self._load(str(self._folder / f"{name}.ttf"), size_px)


class Page:
    """Composes one image of the film from the two views and a `FilmShot`."""

    def __init__(self) -> None:
        with needs("report"):
            from PIL import Image, ImageDraw
        self._pillow, self._drawing, self._fonts = Image, ImageDraw, Fonts()

    def compose(self, chase: Pixels, view: Pixels, about: FilmShot) -> "Pillow.Image":
        """Return the RGB image, `WIDTH_PX` x `HEIGHT_PX`."""
        image, draw = self._paper()
        for left_px, pixels in ((0, chase), (VIEW_PX[0] + _GAP_PX, view)):
            image.paste(self._pillow.fromarray(pixels), (left_px, _TOP_PX))
        self._top(draw, about)
        self._labels(draw, about)
        self._age_bar(draw, about.age_us)
        self._caption(draw, about)
        return image

    def caption_px(self, text: str) -> float:
        """Return the width of a caption, px."""
        return self._fonts.large.getlength(text)

    def close_with(self, lines: Sequence[tuple[str, str, Tone]]) -> "Pillow.Image":
        """Return the last image: a table of events."""
        image, draw = self._paper()
        draw.text((24, 34), "Real processes, simulated robot. Figures: motor log.", _INK, self._fonts.bold)
        for row, (cause, result, tone) in enumerate(lines):
            top_px = 92 + 66 * row
            draw.rounded_rectangle((24, top_px, WIDTH_PX - 24, top_px + 52), 8, _TONES["calm"])
            draw.rounded_rectangle((24, top_px, 34, top_px + 52), 4, _TONES[tone])
            draw.text((50, top_px + 26), cause, _INK, self._fonts.bold, anchor="lm")
            draw.text((WIDTH_PX - 42, top_px + 26), result, _INK, self._fonts.bold, anchor="rm")
        draw.text((24, HEIGHT_PX - 30), "sightline demo --story", _PALE, self._fonts.plain, anchor="lm")
        return image

    def _paper(self) -> "tuple[Pillow.Image, ImageDraw.ImageDraw]":
        image = self._pillow.new("RGB", (WIDTH_PX, HEIGHT_PX), _BACK)
        return image, self._drawing.Draw(image)

    def _top(self, draw: "ImageDraw.ImageDraw", about: FilmShot) -> None:
        """Draw the name of the robot, and on the right the state of its parts."""
        draw.text((14, _TOP_PX / 2), about.name, _INK, self._fonts.large, anchor="lm")
        chips = [(about.state, _STATES.get(about.state, RED)),
                 ("vision on" if about.vision else "vision killed", GREEN if about.vision else RED),
                 ("Wi-Fi on" if about.wifi else "Wi-Fi lost", GREEN if about.wifi else RED)]
        right_px = WIDTH_PX - 12
        for text, color in chips:
            width_px = 24 + round(draw.textlength(text, self._fonts.bold))
            draw.rounded_rectangle((right_px - width_px, 7, right_px, _TOP_PX - 7), 6, color)
            draw.text((right_px - width_px / 2, _TOP_PX / 2), text, (255, 255, 255), self._fonts.bold, anchor="mm")
            right_px -= width_px + 8

    def _labels(self, draw: "ImageDraw.ImageDraw", about: FilmShot) -> None:
        second_px = VIEW_PX[0] + _GAP_PX
        seen = "robot's view"
        if not about.wifi:
            seen += ": not delivered"
        elif not about.vision:
            seen += ": no answer"
        for left_px, text in ((0, "chase camera"), (second_px, seen)):
            self._tag(draw, (left_px + 8, _TOP_PX + 8), text, self._fonts.small)
        self._tag(draw, (8, _TOP_PX + VIEW_PX[1] - 34), f"wheels {about.speed_mps:.2f} m/s", self._fonts.bold)

    def _tag(self, draw: "ImageDraw.ImageDraw", at: tuple[int, int], text: str, font: "ImageFont.FreeTypeFont") -> None:
        left, top, right, bottom = draw.textbbox((at[0] + 6, at[1] + 4), text, font)
        draw.rounded_rectangle((left - 6, top - 5, right + 6, bottom + 5), 5, _BACK)
        draw.text((at[0] + 6, at[1] + 4), text, _INK, font)

    def _age_bar(self, draw: "ImageDraw.ImageDraw", age_us: int | None) -> None:
        """Draw the age of the newest frame behind a command, against the limits of the robot."""
        top_px, left_px, right_px = _TOP_PX + VIEW_PX[1] + 7, 112, WIDTH_PX - 14
        draw.text((14, top_px + 9), "frame age", _INK, self._fonts.plain, anchor="lm")
        draw.rounded_rectangle((left_px, top_px, right_px, top_px + 18), 4, (52, 58, 70))
        share = 1.0 if age_us is None else min(1.0, age_us / 1000 / _BAR_MS)
        end_px = left_px + max(6, round(share * (right_px - left_px)))
        draw.rounded_rectangle((left_px, top_px, end_px, top_px + 18), 4, age_color(age_us))
        for limit_ms, text in ((LIMITS.full_speed_age_ms, "full speed"), (LIMITS.zero_speed_age_ms, "zero speed")):
            at_px = left_px + round(limit_ms / _BAR_MS * (right_px - left_px))
            draw.line((at_px, top_px - 3, at_px, top_px + 24), _INK, 2)
            draw.text((at_px + 6, top_px + 28), f"{text}: {limit_ms} ms", _PALE, self._fonts.small, anchor="lm")

    def _caption(self, draw: "ImageDraw.ImageDraw", about: FilmShot) -> None:
        top_px = HEIGHT_PX - _CAPTION_PX
        draw.rectangle((0, top_px, WIDTH_PX, HEIGHT_PX), _TONES[about.tone])
        draw.text((WIDTH_PX / 2, top_px + _CAPTION_PX / 2), about.caption, (255, 255, 255), self._fonts.large,
                  anchor="mm")


# --- the film --------------------------------------------------------------------------------------------------------

FPS: Final = 12.5
CLOSING_S: Final = 3.0
_QUALITY: Final = 65
_FINE: Final = 2
"""Factor by which the chase camera draws larger, because its renderer has no smooth edges."""


def robot_view(take: Take, t_us: int) -> Pixels:
    """Return the newest frame at `t_us`, darker when it is old, or black before the first."""
    index = bisect_right(take.images, t_us, key=lambda one: one.t_us)
    if not index:
        return np.zeros((VIEW_PX[1], VIEW_PX[0], 3), np.uint8)
    image = take.images[index - 1]
    decoded = cv2.imdecode(np.frombuffer(image.jpeg, np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        return np.zeros((VIEW_PX[1], VIEW_PX[0], 3), np.uint8)
    rgb = cv2.cvtColor(cv2.medianBlur(decoded, 3), cv2.COLOR_BGR2RGB)
    view = cv2.resize(rgb, VIEW_PX, interpolation=cv2.INTER_LINEAR)
    if t_us - image.t_us > LIMITS.zero_speed_age_ms * 1000:
        view = cv2.convertScaleAbs(view, alpha=0.45)
    return np.asarray(view, np.uint8)


def truth_at(truths: Sequence[Truth], t_us: int) -> Truth:
    """Return the newest truth by `t_us`, or the first."""
    return truths[max(0, bisect_right(truths, t_us, key=lambda one: one.t_us) - 1)]


def film_images(
    story: Story, scenario: Scenario, robot: RobotModel, *, show: Callable[[str], None], fps: float = FPS,
) -> "Iterator[Pillow.Image]":
    """Yield every image of the film in order, without the closing one."""
    page, cut = Page(), scenes(story)
    with closing(ChaseCamera(scenario, robot, VIEW_PX[0] * _FINE, VIEW_PX[1] * _FINE)) as chase:
        for number, scene in enumerate(cut, start=1):
            show(f"filming {number} of {len(cut)}: {scene.take.name}")
            for t_us in scene.times_us(fps):
                yield page.compose(_chased(chase, scene, t_us), robot_view(scene.take, t_us),
                                   shot(story, scene.take, t_us))


def _chased(chase: ChaseCamera, scene: FilmScene, t_us: int) -> Pixels:
    fine = chase.draw(truth_at(scene.take.truths, t_us))
    return np.asarray(cv2.resize(fine, VIEW_PX, interpolation=cv2.INTER_AREA), np.uint8)


def write_story(
    path: Path, story: Story, scenario: Scenario, robot: RobotModel, *, show: Callable[[str], None], fps: float = FPS,
) -> int:
    """Write the film and return its images. Raises ConfigError without Pillow or for a place that cannot be written."""
    images = list(film_images(story, scenario, robot, show=show, fps=fps))
    images.append(Page().close_with(closing_lines(story)))
    durations_ms = [round(1000 / fps)] * (len(images) - 1) + [round(1000 * CLOSING_S)]
    show(f"writing {path.name}: {len(images)} images, {sum(durations_ms) / 1000:.0f} s")
    encoded = io.BytesIO()
    images[0].save(encoded, "WEBP", save_all=True, append_images=images[1:], duration=durations_ms, loop=0,
                   quality=_QUALITY, method=4, kmax=60, kmin=30, allow_mixed=True)
    try:
        path.write_bytes(encoded.getvalue())
    except OSError as error:
        path.unlink(missing_ok=True)
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; pass another folder with --out") from None
    return len(images)
