"""A detector behind plain HTTP, for `--detector http+jpeg://...`: an ASGI application without a framework. Shell.

    uvicorn --app-dir examples http_detector:app --port 8080
    sightline vision --detector http+jpeg://127.0.0.1:8080/detect

The request is a POST with a JPEG, the reply is JSON. FastAPI, Ray Serve and BentoML answer the same way: put your own
network into `look`. The headers X-Sightline-Session and X-Sightline-Seq name the frame; returning them is optional.
"""

import json
from typing import Any

import cv2
import numpy as np

YELLOW = (18, 128, 40), (34, 255, 255)
"""Hue (0 to 180), saturation, value (0 to 255) in OpenCV's units: limited on both sides, to exclude green and skin."""
SMALLEST_PX = 6
MAX_JPEG_BYTES = 1_000_000


def look(bgr: Any) -> list[dict[str, Any]]:
    """Return boxes, best first; x2 and y2 are exclusive. An empty list means that the image has none."""
    mask = cv2.inRange(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV), np.array(YELLOW[0]), np.array(YELLOW[1]))
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    x, y, width, height = cv2.boundingRect(max(outlines, key=cv2.contourArea)) if outlines else (0, 0, 0, 0)
    if min(width, height) < SMALLEST_PX:
        return []
    return [{"label": "ball", "score": 0.9, "x1_px": x, "y1_px": y, "x2_px": x + width, "y2_px": y + height}]


def answer(jpeg: bytes) -> tuple[int, dict[str, Any]]:
    """Return (status, reply) for a body."""
    bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    if bgr is None:
        return 422, {"error": "the body is not a JPEG"}
    return 200, {"width_px": bgr.shape[1], "height_px": bgr.shape[0], "boxes": look(bgr), "detector": "yellow"}


async def _body(receive: Any) -> bytes | None:
    """Return the whole body; None if it is larger than an image."""
    body, more = b"", True
    while more and len(body) <= MAX_JPEG_BYTES:
        message = await receive()
        body += message.get("body", b"")
        more = message.get("more_body", False)
    return None if more else body


async def app(scope: Any, receive: Any, send: Any) -> None:
    """Serve requests as an ASGI application."""
    if scope["type"] != "http":
        return
    body = await _body(receive) if scope["method"] == "POST" else b""
    status, content = (413, {"error": "too large"}) if body is None else answer(body)
    data = json.dumps(content).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(data)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": data})
