"""A model for Triton's Python backend: finds the yellow objects in a JPEG. Shell (Triton calls it).

Put your own network into `look`. Unused rows have the score 0, which is not a box for any client.
"""

from typing import Any

import cv2
import numpy as np
import triton_python_backend_utils as pb_utils

ROWS = 16
YELLOW = (18, 128, 40), (34, 255, 255)
"""Hue (0 to 180), saturation, value (0 to 255) in OpenCV's units: limited on both sides, to exclude green and skin."""
SMALLEST_PX = 6


def look(bgr: Any) -> list[tuple[int, int, int, int]]:
    """Return boxes (x1, y1, x2, y2), the largest first."""
    mask = cv2.inRange(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV), np.array(YELLOW[0]), np.array(YELLOW[1]))
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    found = [cv2.boundingRect(outline) for outline in sorted(outlines, key=cv2.contourArea, reverse=True)[:ROWS]]
    return [(x, y, x + width, y + height) for x, y, width, height in found if min(width, height) >= SMALLEST_PX]


class TritonPythonModel:
    """The class that Triton loads."""

    def execute(self, requests: list[Any]) -> list[Any]:
        """Return one response for each request; a request holds a batch of one or more images."""
        return [self._answer(pb_utils.get_input_tensor_by_name(one, "image").as_numpy()) for one in requests]

    def _answer(self, jpegs: Any) -> Any:
        boxes = np.zeros((len(jpegs), ROWS, 4), np.float32)
        scores = np.zeros((len(jpegs), ROWS), np.float32)
        labels = np.full((len(jpegs), ROWS), b"", np.object_)
        for row, (jpeg,) in enumerate(jpegs):
            bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
            if bgr is None:
                return pb_utils.InferenceResponse(error=pb_utils.TritonError("a picture does not decode"))
            found = look(bgr)
            boxes[row, : len(found)], scores[row, : len(found)], labels[row, : len(found)] = found or 0, 0.9, b"ball"
        named = {"boxes": boxes, "scores": scores, "labels": labels}
        return pb_utils.InferenceResponse([pb_utils.Tensor(name, column) for name, column in named.items()])
