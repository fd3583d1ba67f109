"""run.mp4: the robot's view next to the world from above. Shell (files)."""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.evaluation.plots import StatusAt, scale_length_m, wall_corners
from sightline.operator_side.recording.film import Film
from sightline.operator_side.recording.replay import recorded_frames, replay_steps
from sightline.sim.scenario import Scenario, Static
from sightline.sim.truth import Truth
from sightline.vision_side.pipeline import Frame, PipelineAnswer

Image = NDArray[np.uint8]
Point = tuple[int, int]
Color = tuple[int, int, int]

_PAPER, _WALL, _ROBOT, _TARGET = (245, 245, 245), (150, 150, 150), (180, 110, 30), (20, 170, 230)  # BGR
_INK, _FONT = (40, 40, 40), cv2.FONT_HERSHEY_SIMPLEX
_MARGIN_M = 0.4
_SHIFT = 4  # OpenCV draws at sixteenths of a pixel


class TopView:
    """A square image with a growing path: call `draw` with the index of each next sample."""

    def __init__(self, samples: Sequence[Truth], scenario: Scenario, size_px: int) -> None:
        """Draw the fixed parts. Raises ValueError without samples."""
        self._samples, self._radius_m, self._size_px = samples, scenario.target.reach_m, size_px
        corners = [corner for wall in scenario.walls for corner in wall_corners(wall)]
        xs = [x for t in samples for x in (t.x_m, t.target_x_m)] + [x for x, _ in corners]
        ys = [y for t in samples for y in (t.y_m, t.target_y_m)] + [y for _, y in corners]
        span_m = max(max(xs) - min(xs), max(ys) - min(ys)) + 2 * _MARGIN_M
        self._scale = size_px / span_m
        self._middle = ((max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2)
        self._drawn = 0
        self._paper = np.full((size_px, size_px, 3), _PAPER, np.uint8)
        for wall in scenario.walls:
            outline = np.array([self._at(*corner) for corner in wall_corners(wall)], np.int32)
            cv2.fillPoly(self._paper, [outline], _WALL, cv2.LINE_AA, _SHIFT)
        for thing in scenario.things:
            if isinstance(thing, Static):
                self._disc(self._paper, thing.at_m, thing.reach_m, _WALL)
        self._has_target = scenario.target.shape != "place"
        self._key(scale_length_m(span_m))

    def _key(self, length_m: float) -> None:
        """Draw the legend in the margin above and the scale in the margin below."""
        left_px, low_px, length_px = 14, self._size_px - 18, round(length_m * self._scale)
        cv2.line(self._paper, (left_px, low_px), (left_px + length_px, low_px), _INK, 2)
        for end_px in (left_px, left_px + length_px):
            cv2.line(self._paper, (end_px, low_px - 5), (end_px, low_px + 5), _INK, 2)
        beside = (left_px + length_px + 10, low_px + 5)
        cv2.putText(self._paper, f"{length_m:g} m", beside, _FONT, 0.5, _INK, 1, cv2.LINE_AA)
        names = [("robot", _ROBOT), *([("target", _TARGET)] if self._has_target else [])]
        for column, (name, color) in enumerate(names):
            at_px = 20 + 90 * column
            cv2.circle(self._paper, (at_px, 16), 6, color, -1, cv2.LINE_AA)
            cv2.putText(self._paper, name, (at_px + 14, 21), _FONT, 0.5, _INK, 1, cv2.LINE_AA)

    def draw(self, index: int) -> Image:
        """Draw the image of sample `index`, which never decreases."""
        for at in range(self._drawn, index):
            now, then = self._samples[at], self._samples[at + 1]
            self._line((now.x_m, now.y_m), (then.x_m, then.y_m), _ROBOT)
            self._line((now.target_x_m, now.target_y_m), (then.target_x_m, then.target_y_m), _TARGET)
        self._drawn = max(self._drawn, index)
        picture = self._paper.copy()
        truth = self._samples[index]
        self._disc(picture, (truth.target_x_m, truth.target_y_m), self._radius_m, _TARGET)
        self._robot(picture, truth)
        return picture

    def _robot(self, picture: Image, truth: Truth) -> None:
        """Draw an arrowhead on the axle, as long as the robot."""
        corners = [(0.1, 0.0), (-0.08, 0.08), (-0.04, 0.0), (-0.08, -0.08)]
        cos, sin = math.cos(truth.yaw_rad), math.sin(truth.yaw_rad)
        outline = [self._at(truth.x_m + x * cos - y * sin, truth.y_m + x * sin + y * cos) for x, y in corners]
        cv2.fillPoly(picture, [np.array(outline, np.int32)], _ROBOT, cv2.LINE_AA, _SHIFT)

    def _disc(self, picture: Image, center: tuple[float, float], radius_m: float, color: Color) -> None:
        radius_px = max(2.0, radius_m * self._scale)
        cv2.circle(picture, self._at(*center), round(radius_px * 2**_SHIFT), color, -1, cv2.LINE_AA, _SHIFT)

    def _line(self, start: tuple[float, float], end: tuple[float, float], color: Color) -> None:
        cv2.line(self._paper, self._at(*start), self._at(*end), color, 1, cv2.LINE_AA, _SHIFT)

    def _at(self, x_m: float, y_m: float) -> Point:
        """Convert world coordinates to sixteenths of pixels: x right, y up."""
        half = self._size_px / 2
        x_px = half + (x_m - self._middle[0]) * self._scale
        y_px = half - (y_m - self._middle[1]) * self._scale
        return round(x_px * 2**_SHIFT), round(y_px * 2**_SHIFT)


# run.mp4: the robot's view with the detections, next to the world from above. Shell (reads and writes files).
#
# It is made after the run from its recording, so it does not slow the run. The pipeline processes the frames again.


FPS: Final = 15
HEIGHT_PX: Final = 480
_BOX, _TEXT, _SHADOW = (60, 220, 60), (255, 255, 255), (0, 0, 0)


def film_run(
    path: Path, recording: Path, samples: Sequence[Truth], scenario: Scenario, statuses: Sequence[StatusAt] = ()
) -> int:
    """Write the film of a run (at least one sample) and return its frames. Raises ConfigError without PyAV."""
    view = TopView(samples, scenario, HEIGHT_PX)
    times_us = [truth.t_us for truth in samples]
    with Film(path, FPS) as film:
        for frame, answer in _thinned(recording, times_us[0]):
            index = min(bisect_right(times_us, frame.header.t_us), len(samples) - 1)
            status = newest_status(statuses, frame.header.t_us)
            film.add(np.hstack([_robot_view(frame, answer, status), view.draw(index)]), frame.header.t_us)
        if not film.frames:  # FFmpeg writes no file without an image
            film.add(view.draw(len(samples) - 1), times_us[-1])
    return film.frames


def _thinned(recording: Path, start_us: int) -> Iterator[tuple[Frame, PipelineAnswer | None]]:
    """Yield the frames of the run, with their answers, at `FPS` at most."""
    due_us = start_us
    for frame, answer in _views(recording):
        t_us = frame.header.t_us
        if t_us >= due_us:
            # At least one tick on, because a frame that was acknowledged and then answered comes twice.
            due_us = max(due_us, t_us - 1_000_000 // FPS + 1) + 1_000_000 // FPS
            yield frame, answer


def _views(recording: Path) -> Iterator[tuple[Frame, PipelineAnswer | None]]:
    """Yield each answered frame with its answer; all frames without one if the answers crossed another transport."""
    is_answered = False
    for step in replay_steps(recording):
        is_answered = True
        yield step.frame, step.answer
    if not is_answered:
        yield from ((frame, None) for frame in recorded_frames(recording))


def newest_status(statuses: Sequence[StatusAt], t_us: int) -> StatusAt | None:
    """Return the newest status by `t_us`; None before the first."""
    index = bisect_right(statuses, t_us, key=lambda one: one.t_us)
    return statuses[index - 1] if index else None


def status_text(status: StatusAt | None) -> str:
    """Describe state and frame age for the film; "" without a status."""
    if status is None:
        return ""
    age = "no frame" if status.frame_age_us is None else f"frame age {status.frame_age_us / 1000:.0f} ms"
    return f"{status.state}  {age}"


def _robot_view(frame: Frame, answer: PipelineAnswer | None, status: StatusAt | None) -> Image:
    """Draw the image with detections, phase, state, frame age and twist, `HEIGHT_PX` high, its width even."""
    decoded = cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        decoded = np.zeros((HEIGHT_PX, HEIGHT_PX * 4 // 3, 3), np.uint8)
    scale = HEIGHT_PX / decoded.shape[0]
    width_px = round(decoded.shape[1] * scale / 2) * 2
    picture = np.asarray(cv2.resize(decoded, (width_px, HEIGHT_PX), interpolation=cv2.INTER_LINEAR), np.uint8)
    if answer is not None:
        _overlay(picture, answer, scale)
    _write(picture, status_text(status), 54)
    return picture


def _overlay(picture: Image, answer: PipelineAnswer, scale: float) -> None:
    seen = answer.seen
    for one in seen.detections:
        width = 2 if one is seen.target else 1
        if one.circle is not None:
            center = round(one.circle.cx_px * scale), round(one.circle.cy_px * scale)
            cv2.circle(picture, center, round(one.circle.radius_px * scale), _BOX, width, cv2.LINE_AA)
        corners = [round(value * scale) for value in (one.x1_px, one.y1_px, one.x2_px, one.y2_px)]
        cv2.rectangle(picture, (corners[0], corners[1]), (corners[2], corners[3]), _BOX, width)
    twist = answer.twist
    command = f"{twist.linear_mps:+.2f} m/s {twist.angular_rad_s:+.2f} rad/s" if twist else "no command"
    _write(picture, seen.phase + (f"  {seen.distance_m:.2f} m" if seen.distance_m is not None else ""), 28)
    _write(picture, command, HEIGHT_PX - 14)


def _write(picture: Image, text: str, y_px: int) -> None:
    for color, off_px in ((_SHADOW, 1), (_TEXT, 0)):
        at = (12 + off_px, y_px + off_px)
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, color, 1, cv2.LINE_AA)
