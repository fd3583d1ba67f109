"""A sheet of pictures: the first scenes of each column with what each detector answered. Pure (OpenCV)."""

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.evaluation.score.detector_report import ScoredScene, Subject, detections, scene_result

_ACROSS: Final = 6
_TRUE_BGR: Final = (255, 255, 255)
_COLOURS: Final = ((60, 220, 60), (255, 160, 40), (60, 60, 255), (220, 60, 220), (60, 220, 255))
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_MOST_DRAWN: Final = 4  # detections of one detector; more would hide the picture


class Sheet:
    """Collects scenes; `picture` is the sheet."""

    def __init__(self, asked: Sequence[Subject]) -> None:
        self._asked = asked
        self._rows: dict[str, list[npt.NDArray[np.uint8]]] = {}

    def add(self, seen: ScoredScene) -> None:
        """The first few of each column are kept."""
        row = self._rows.setdefault(seen.scene.plan.column.name, [])
        if len(row) < _ACROSS:
            row.append(self._drawn(seen))

    def picture(self) -> npt.NDArray[np.uint8]:
        """One row for each column."""
        return np.vstack([_row(name, pictures) for name, pictures in self._rows.items()])

    def _drawn(self, seen: ScoredScene) -> npt.NDArray[np.uint8]:
        picture: npt.NDArray[np.uint8] = simplejpeg.decode_jpeg(seen.jpeg, "BGR")
        for truth in seen.scene.truths:
            _box(picture, truth.box, _TRUE_BGR)
        for number, (subject, result) in enumerate(zip(self._asked, seen.answers, strict=True)):
            colour = _COLOURS[number % len(_COLOURS)]
            for one in detections(result)[:_MOST_DRAWN]:
                _box(picture, (one.x1_px, one.y1_px, one.x2_px, one.y2_px), colour)
                at = (int(one.x1_px), max(9, int(one.y1_px) - 2))
                cv2.putText(picture, f"{one.label} {one.score:.2f}", at, _FONT, 0.3, colour, 1, cv2.LINE_AA)
            said = f"{subject.name}: {scene_result(result, seen.scene, subject.balls).verdict}"
            cv2.putText(picture, said, (3, 12 + 12 * number), _FONT, 0.36, colour, 1, cv2.LINE_AA)
        return picture


def _row(name: str, pictures: list[npt.NDArray[np.uint8]]) -> npt.NDArray[Any]:
    blank = np.zeros_like(pictures[0])
    row = np.hstack([*pictures, *[blank] * (_ACROSS - len(pictures))])
    title = np.zeros((18, row.shape[1], 3), np.uint8)
    cv2.putText(title, f"{name} (white: the truth)", (4, 13), _FONT, 0.45, _TRUE_BGR, 1, cv2.LINE_AA)
    return np.vstack([title, row])


def _box(picture: npt.NDArray[np.uint8], box: tuple[float, float, float, float], colour: tuple[int, int, int]) -> None:
    x1, y1, x2, y2 = (round(edge) for edge in box)
    cv2.rectangle(picture, (x1, y1), (x2 - 1, y2 - 1), colour, 1)
