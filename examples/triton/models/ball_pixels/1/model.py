"""A model for Triton's Python backend: finds yellow objects in pixels (BGR, rows first). Shell (Triton calls it)."""

from typing import Any

import cv2
import numpy as np
import triton_python_backend_utils as pb_utils

ROWS = 16
YELLOW = (18, 128, 40), (34, 255, 255)
BALL = 0
"""Labels are numbers here. Their names are set at the client, e.g. --set 'detector.options.labels=["ball"]'."""


class TritonPythonModel:
    """The class that Triton loads."""

    def execute(self, requests: list[Any]) -> list[Any]:
        """Return one response for each request; a request holds a batch of one or more images."""
        return [self._answer(pb_utils.get_input_tensor_by_name(one, "image").as_numpy()) for one in requests]

    def _answer(self, pictures: Any) -> Any:
        boxes = np.zeros((len(pictures), ROWS, 4), np.float32)
        scores = np.zeros((len(pictures), ROWS), np.float32)
        for row, bgr in enumerate(pictures):
            mask = cv2.inRange(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV), np.array(YELLOW[0]), np.array(YELLOW[1]))
            x, y, width, height = cv2.boundingRect(mask)
            if width and height:
                boxes[row, 0], scores[row, 0] = (x, y, x + width, y + height), 0.9
        named = {"boxes": boxes, "scores": scores, "labels": np.full(scores.shape, BALL, np.int64)}
        return pb_utils.InferenceResponse([pb_utils.Tensor(name, column) for name, column in named.items()])
