"""The legacy article's vision program, in our words, with its library `websocket-client`: no windows, else as it was.

    python old_vision.py ws://127.0.0.1:9091/ FRAMES.csv

Silent and not reading for its first 1.5 s, newest picture wins, `linear|angular` with all the digits Python prints and
an integer zero, up to 48 m/s. It writes `t_us,characters,twist` for every picture it has answered.
"""

import base64
import sys
import threading
import time

import cv2
import numpy
import websocket

LOWER, UPPER = (20, 25, 25), (64, 255, 255)
SILENT_S = 1.5

newest, fresh = [""], threading.Event()
connected = threading.Event()


def on_open(_app):
    time.sleep(SILENT_S)  # on the thread that reads
    connected.set()


def on_message(_app, message):
    newest[0] = message
    fresh.set()


def twist_for(picture):
    """Towards the largest blob, the faster the smaller it is."""
    mask = cv2.inRange(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV), LOWER, UPPER)
    mask = cv2.dilate(cv2.erode(mask, None, iterations=2), None, iterations=2)
    contours = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)[0]
    largest = max(contours, key=cv2.contourArea, default=None)
    area = 0 if largest is None else cv2.contourArea(largest)
    if area <= 4:
        return 0, 0
    left, _, width, _ = cv2.boundingRect(largest)
    turn = (left + width / 2 - picture.shape[1] / 2) * -0.005
    return 200 / area, turn + 0.007 * turn if abs(turn) > 0.1 else 0


def main(url, path):
    app = websocket.WebSocketApp(url, on_open=on_open, on_message=on_message)
    threading.Thread(target=app.run_forever, daemon=True).start()
    with open(path, "w", buffering=1) as log:  # noqa: PTH123
        while True:
            fresh.wait()
            fresh.clear()
            text = newest[0]
            pixels = numpy.frombuffer(base64.decodebytes(text.encode("utf-8")), numpy.uint8)
            linear, angular = twist_for(cv2.imdecode(pixels, cv2.IMREAD_COLOR))
            answer = f"{linear}|{angular}"
            if connected.is_set():
                app.send(answer)
            log.write(f"{time.monotonic_ns() // 1000},{len(text)},{answer}\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
