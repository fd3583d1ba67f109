"""run.mp4: the robot's view with what vision saw in it, beside the world from above. Shell (reads and writes files).

Made after the run from its recording, so it costs the run nothing: the pipeline says again what it saw.
"""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.operator_side.film import Film
from sightline.operator_side.recording.replay import Step, replay_steps
from sightline.evaluation.demo.video import TopView
from sightline.sim.scenario import Scenario
from sightline.sim.truth import Truth

Image = NDArray[np.uint8]

FPS: Final = 15
HEIGHT_PX: Final = 480
_BOX, _TEXT, _SHADOW = (60, 220, 60), (255, 255, 255), (0, 0, 0)


def film_run(path: Path, recording: Path, samples: Sequence[Truth], scenario: Scenario) -> int:
    """Write the film of a run (at least one sample) and return its frames. Raises ConfigError without PyAV."""
    view = TopView(samples, scenario, HEIGHT_PX)
    times_us = [truth.t_us for truth in samples]
    with Film(path, FPS) as film:
        for step in _thinned(recording, times_us[0]):
            index = min(bisect_right(times_us, step.frame.header.t_us), len(samples) - 1)
            film.add(np.hstack([_robot_view(step), view.draw(index)]), step.frame.header.t_us)
    return film.frames


def _thinned(recording: Path, start_us: int) -> Iterator[Step]:
    """Steps of the run at no more than `FPS`."""
    due_us = start_us
    for step in replay_steps(recording):
        t_us = step.frame.header.t_us
        if t_us >= due_us:
            # At least one tick on: a frame that was acknowledged and then answered comes twice, and is shown once.
            due_us = max(due_us, t_us - 1_000_000 // FPS + 1) + 1_000_000 // FPS
            yield step


def _robot_view(step: Step) -> Image:
    """The picture with detections, phase and twist, `HEIGHT_PX` high and an even number of pixels wide."""
    decoded = cv2.imdecode(np.frombuffer(step.frame.jpeg, np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        decoded = np.zeros((HEIGHT_PX, HEIGHT_PX * 4 // 3, 3), np.uint8)
    scale = HEIGHT_PX / decoded.shape[0]
    width_px = round(decoded.shape[1] * scale / 2) * 2
    picture = np.asarray(cv2.resize(decoded, (width_px, HEIGHT_PX), interpolation=cv2.INTER_LINEAR), np.uint8)
    _overlay(picture, step, scale)
    return picture


def _overlay(picture: Image, step: Step, scale: float) -> None:
    seen = step.answer.seen
    for one in seen.detections:
        width = 2 if one is seen.target else 1
        if one.circle is not None:
            centre = round(one.circle.cx_px * scale), round(one.circle.cy_px * scale)
            cv2.circle(picture, centre, round(one.circle.radius_px * scale), _BOX, width, cv2.LINE_AA)
        corners = [round(value * scale) for value in (one.x1_px, one.y1_px, one.x2_px, one.y2_px)]
        cv2.rectangle(picture, (corners[0], corners[1]), (corners[2], corners[3]), _BOX, width)
    twist = step.answer.twist
    command = f"{twist.linear_mps:+.2f} m/s {twist.angular_rad_s:+.2f} rad/s" if twist else "no command"
    _write(picture, seen.phase + (f"  {seen.distance_m:.2f} m" if seen.distance_m is not None else ""), 28)
    _write(picture, command, HEIGHT_PX - 14)


def _write(picture: Image, text: str, y_px: int) -> None:
    for colour, off_px in ((_SHADOW, 1), (_TEXT, 0)):
        at = (12 + off_px, y_px + off_px)
        cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 1, cv2.LINE_AA)
