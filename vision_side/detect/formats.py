"""Detections in the shapes that other tools take: supervision, ROS vision_msgs, Foxglove annotations. Pure.

None of them is imported: these are the fields by their names, to be handed to the other's own constructor.

    supervision.Detections(**supervision_fields(result))
"""

from typing import Any

import numpy as np

from sightline.vision_side.detect.port import Detection, DetectionResult

_RGBA = {"r": 0.95, "g": 0.78, "b": 0.05, "a": 1.0}
_LINE_LOOP, _LINE_PX, _FONT_PX = 2, 2.0, 12.0  # of foxglove.PointsAnnotation.Type: closed


def supervision_fields(result: DetectionResult, labels: tuple[str, ...] = ()) -> dict[str, Any]:
    """Keyword arguments of `supervision.Detections`.

    `labels` gives class ids their order; without it they are numbered as they come. `data["class_name"]` has the words.
    """
    found = result.detections
    names = list(labels) or list(dict.fromkeys(one.label for one in found))
    fields: dict[str, Any] = {
        "xyxy": np.array([[one.x1_px, one.y1_px, one.x2_px, one.y2_px] for one in found], np.float32).reshape(-1, 4),
        "confidence": np.array([one.score for one in found], np.float32),
        "class_id": np.array([names.index(one.label) if one.label in names else -1 for one in found], int),
        "data": {"class_name": np.array([one.label for one in found], str)},
    }
    if found and all(one.track_id is not None for one in found):
        fields["tracker_id"] = np.array([one.track_id for one in found], int)
    return fields


def vision_msgs_fields(result: DetectionResult, frame_id: str = "camera") -> dict[str, Any]:
    """A `vision_msgs/Detection2DArray`, field by field. Its boxes go by centre and size."""
    stamp = {"sec": result.t_us // 1_000_000, "nanosec": result.t_us % 1_000_000 * 1000}
    header = {"stamp": stamp, "frame_id": frame_id}
    return {"header": header, "detections": [_detection_2d(one, header) for one in result.detections]}


def _detection_2d(one: Detection, header: dict[str, Any]) -> dict[str, Any]:
    centre = {"x": (one.x1_px + one.x2_px) / 2, "y": (one.y1_px + one.y2_px) / 2}
    return {
        "header": header,
        "results": [{"hypothesis": {"class_id": one.label, "score": one.score}}],
        "bbox": {"center": {"position": centre, "theta": 0.0}, "size_x": one.x2_px - one.x1_px,
                 "size_y": one.y2_px - one.y1_px},
        "id": "" if one.track_id is None else str(one.track_id),
    }


def foxglove_annotations(result: DetectionResult) -> dict[str, Any]:
    """A `foxglove.ImageAnnotations` as JSON: a box and a word each, and a circle where one is known."""
    stamp = {"sec": result.t_us // 1_000_000, "nsec": result.t_us % 1_000_000 * 1000}
    circles = [
        {"timestamp": stamp, "position": {"x": one.circle.cx_px, "y": one.circle.cy_px},
         "diameter": 2 * one.circle.radius_px, "thickness": _LINE_PX, "fill_color": {**_RGBA, "a": 0.0},
         "outline_color": _RGBA}
        for one in result.detections if one.circle
    ]
    boxes = [
        {"timestamp": stamp, "type": _LINE_LOOP, "points": _corners(one), "outline_color": _RGBA, "thickness": _LINE_PX,
         "outline_colors": [], "fill_color": {**_RGBA, "a": 0.0}}
        for one in result.detections
    ]
    texts = [
        {"timestamp": stamp, "position": {"x": one.x1_px, "y": one.y1_px}, "text": f"{one.label} {one.score:.2f}",
         "font_size": _FONT_PX, "text_color": _RGBA, "background_color": {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.6}}
        for one in result.detections
    ]
    return {"circles": circles, "points": boxes, "texts": texts}


def _corners(one: Detection) -> list[dict[str, float]]:
    left, top, right, bottom = one.x1_px, one.y1_px, one.x2_px, one.y2_px
    return [{"x": x, "y": y} for x, y in ((left, top), (right, top), (right, bottom), (left, bottom))]
