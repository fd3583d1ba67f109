"""Run a client of the legacy protocol, as in its articles: base64 images in, `linear|angular` out, port 9091. Shell.

    python examples/compose/older_client.py ws://127.0.0.1:9091

It has nothing of Sightline: no header, age or lease. The robot treats it as a guest, if guests are enabled.
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
"""Width of a ball of 0.2 m in the simulated camera (320 pixels, 80 degrees) from 0.67 m. Behind a rolling ball the
robot stays further back, since only distance makes it drive.
"""
TURN, AHEAD = 2.2, 1.2
"""rad/s for a ball at the image border, m/s for an infinitely distant ball."""


def steer(text: str | bytes) -> str:
    """Map an image as text to a twist as text: towards the largest yellow object, or turning to find it."""
    bgr = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        return "0.0|0.0"
    mask = cv2.inRange(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV), np.array(YELLOW[0]), np.array(YELLOW[1]))
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not outlines:
        # The robot stops a guest that repeats one twist for 2 s. Only a new twist shows that the image changes.
        return f"0.0|{0.5 + crc32(text if isinstance(text, bytes) else text.encode()) % 8 / 1000}"
    x, _, width, height = cv2.boundingRect(max(outlines, key=cv2.contourArea))
    half = bgr.shape[1] / 2
    aside = (half - x - width / 2) / half
    return f"{AHEAD * (1 - max(width, height) / STAND_OFF_PX)}|{TURN * aside}"


def drive(robot: ClientConnection) -> None:
    """Answer every image."""
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
