"""Run a client of the legacy protocol, as in its articles: base64 images in, `linear|angular` out, port 9091. Shell.

    python examples/compose/older_client.py ws://127.0.0.1:9091

It knows nothing of Sightline: no header, no age, no lease. So the robot takes it for a guest, if its owner lets it.
"""

import base64
import sys
import time
from zlib import crc32

import cv2
import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

YELLOW = (18, 128, 40), (34, 255, 255)
STAND_OFF_PX = 57.0
"""How wide a ball of 0.2 m is in the simulated camera (320 pixels, 80 degrees) from 0.67 m; behind a rolling one the
robot stays further back, since only distance makes it drive."""
TURN, AHEAD = 2.2, 1.2
"""rad/s for a ball at the picture's very edge, m/s for one that is infinitely far."""


def steer(text: str | bytes) -> str:
    """A picture as text in, a twist as text out: towards the largest yellow thing, or turning to find it."""
    bgr = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        return "0.0|0.0"
    mask = cv2.inRange(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV), np.array(YELLOW[0]), np.array(YELLOW[1]))
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not outlines:
        # The robot stops a guest that repeats one twist for 2 s: only another one shows that the picture changes.
        return f"0.0|{0.5 + crc32(text if isinstance(text, bytes) else text.encode()) % 8 / 1000}"
    x, _, width, height = cv2.boundingRect(max(outlines, key=cv2.contourArea))
    half = bgr.shape[1] / 2
    aside = (half - x - width / 2) / half
    return f"{AHEAD * (1 - max(width, height) / STAND_OFF_PX)}|{TURN * aside}"


def drive(robot: ClientConnection) -> None:
    """Answer every picture."""
    for text in robot:
        robot.send(steer(text))


def main(url: str) -> None:
    while True:
        try:
            with connect(url, compression=None, proxy=None) as robot:
                print(f"legacy client: driving by the images of {url}", flush=True)
                drive(robot)
        except (OSError, WebSocketException) as error:
            print(f"legacy client: {error}; trying again", flush=True)
        time.sleep(0.5)


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except KeyboardInterrupt:
        pass
    except IndexError:
        sys.exit("error: which robot? give its endpoint, e.g. older_client.py ws://127.0.0.1:9091")
