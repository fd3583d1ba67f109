"""What tests of remote detectors share: frames to ask about, and servers that answer as they are told to."""

import json
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sightline.protocol.clock import monotonic_us
from sightline.protocol.messages import FrameHeader
from tests.vision_rig import camera, jpeg_of, scene
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import DetectFrame
from sightline.vision_side.detect.protobuf import put, put_integers
from sightline.vision_side.detect.remote.oip import Slot

SESSION = "0000abcd"
MODEL = camera()
BALL_JPEG = jpeg_of(scene(MODEL, 1.0, 0.1, noise=0.0))
GREY_JPEG = jpeg_of(np.full((240, 320, 3), 128, np.uint8))


def frame(seq=1, jpeg=BALL_JPEG, robot="r1", session=SESSION, width_px=320, height_px=240):
    header = FrameHeader(session=session, seq=seq, t_us=seq * 33_333)
    return DetectFrame(robot, header, jpeg, Decoder(width_px, height_px, 1920 * 1080))


def within(seconds):
    """A deadline."""
    return monotonic_us() + round(seconds * 1e6)


def http_reply(body, status="200 OK", headers=(), length=None):
    lines = [f"HTTP/1.1 {status}", f"Content-Length: {len(body) if length is None else length}", *headers]
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


def said(*boxes, width_px=320, height_px=240, **more):
    """The answer of an `http+jpeg` server."""
    return json.dumps({"width_px": width_px, "height_px": height_px, "boxes": list(boxes), **more}).encode()


def box(x1=100.0, y1=80.0, x2=140.0, y2=120.0, score=0.9, label="ball"):
    return {"label": label, "score": score, "x1_px": x1, "y1_px": y1, "x2_px": x2, "y2_px": y2}


JPEG_INPUT = Slot("image", "BYTES", (-1, 1))
OUTPUTS = [Slot("boxes", "FP32", (-1, 4)), Slot("scores", "FP32", (-1,)), Slot("labels", "INT64", (-1,))]
COLUMNS = {"boxes": np.float32([[10, 20, 30, 40]]), "scores": np.float32([0.9]), "labels": np.int64([1])}
ASKED = f"{SESSION}-1"
"""The id of a request about `frame()`."""


def grpc_answer(columns, answer_id=ASKED, version=""):
    """A ModelInferResponse."""
    kinds = {one.name: one.datatype for one in OUTPUTS}
    slots = [put(1, name) + put(2, kinds[name]) + put_integers(3, column.shape) for name, column in columns.items()]
    contents = [put(6, column.tobytes()) for column in columns.values()]
    head = put(1, "ball") + (put(2, version) if version else b"") + put(3, answer_id)
    return b"".join((head, *(put(5, slot) for slot in slots), *contents))


def grpc_started(infer, port=0, metadata=None):
    """A server of the Open Inference Protocol and its port; `infer(request, context)` gives bytes or raises."""
    grpc = pytest.importorskip("grpc")
    slots = [put(1, one.name) + put(2, one.datatype) + put_integers(3, one.shape) for one in (JPEG_INPUT, *OUTPUTS)]
    usual = put(1, "ball") + put(4, slots[0]) + b"".join(put(5, one) for one in slots[1:])
    answers = {"ModelMetadata": lambda request, context: usual if metadata is None else metadata, "ModelInfer": infer}
    handlers = {name: grpc.unary_unary_rpc_method_handler(answer) for name, answer in answers.items()}
    server = grpc.server(ThreadPoolExecutor(2), compression=getattr(infer, "compression", None),
                         options=[("grpc.max_send_message_length", -1)])
    server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler("inference.GRPCInferenceService", handlers)])
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    return server, port


class Server:
    """A TCP server on loopback. `answer(request)` gives the bytes to reply with (an iterable: one after the other), or
    None to say nothing at all; it is called for every HTTP request, whole."""

    def __init__(self, answer):
        self.answer = answer
        self.requests = []
        self.connections = 0
        self._closed = False
        self._open = []
        self.start()

    def start(self, port=0):
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self._closed = False
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def kill(self):
        """As a process that is killed: its socket and every connection end at once."""
        self._closed = True
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for one in self._open:
            one.close()
        self._open.clear()

    def _accept(self, listener):
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            self.connections += 1
            self._open.append(connection)
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def _serve(self, connection):
        try:
            while (request := _request(connection)) is not None:
                self.requests.append(request)
                reply = self.answer(request)
                for part in (reply,) if isinstance(reply, bytes) else reply or ():
                    connection.sendall(part)
        except OSError:
            pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if not self._closed:
            self.kill()


def _request(connection):
    """(head, body) of the next request; None at the end."""
    data = b""
    while b"\r\n\r\n" not in data:
        more = connection.recv(65536)
        if not more:
            return None
        data += more
    head, _, body = data.partition(b"\r\n\r\n")
    lengths = [line for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:")]
    length = int(lengths[0].partition(b":")[2]) if lengths else 0
    while len(body) < length:
        body += connection.recv(65536)
    return head.decode(), body
