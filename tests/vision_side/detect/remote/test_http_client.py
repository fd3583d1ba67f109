"""`http+jpeg` against real sockets: requests, valid answers, and every hostile answer rejected and counted."""

import gzip
import resource
import socket
import threading
import time

import pytest

from sightline.protocol.errors import ConfigError
from sightline.vision_side.detect.remote import http_client
from sightline.vision_side.detect.remote.client import ServerDetector, parse_address
from sightline.vision_side.detect.remote.http_client import (
    MAX_ANSWER_BYTES,
    RETRY_US,
    HttpExchange,
    HttpJpeg,
    JpegServer,
)
from tests.fixtures.links import until
from tests.fixtures.ports import free_port
from tests.fixtures.vision.remote import BALL_JPEG, GREY_JPEG, Server, box, frame, http_reply, said, within

GOOD = http_reply(said(box()))


def _asking(server, min_score=0.25):
    address = f"http+jpeg://127.0.0.1:{server.port}/detect?size=320"
    return ServerDetector(address, JpegServer(parse_address(address), min_score))


def _ask(detector, seconds=2.0, **about):
    return detector.detect([frame(**about)], within(seconds))[0]


def test_a_jpeg_goes_out_as_it_came_and_boxes_come_back():
    with Server(lambda request: GOOD) as server:
        detector = _asking(server)
        result = _ask(detector, seq=7)
        head, body = server.requests[0]
    assert body == BALL_JPEG and head.startswith("POST /detect?size=320 HTTP/1.1")
    named = {"Content-Type: image/jpeg", "X-Sightline-Session: 0000abcd", "X-Sightline-Seq: 7"}
    assert named <= set(head.split("\r\n"))
    one = result.detections[0]
    assert (one.label, one.score, one.x1_px, one.y1_px, one.x2_px, one.y2_px) == ("ball", 0.9, 100, 80, 140, 120)
    assert (result.robot, result.session, result.seq, result.t_us) == ("r1", "0000abcd", 7, 7 * 33_333)
    assert (result.width_px, result.height_px, result.device) == (320, 240, "remote") and not detector.rejected


def test_empty_result_is_an_answer_and_the_server_may_name_itself():
    words = {"detector": "my-net", "model_hash": "ab" * 20, "device": "cuda", "session": "0000abcd", "seq": 1}
    with Server(lambda request: http_reply(said(**words))) as server:
        result = _ask(_asking(server))
    assert result.detections == ()
    assert (result.detector, result.model_hash, result.device) == ("my-net", "ab" * 8, "cuda")


def test_boxes_are_clipped_sorted_and_those_of_low_score_or_outside_left_out():
    boxes = [box(-50, 10, 20, 40, 0.5), box(score=0.1), box(400, 10, 420, 30, 0.9), box(300, 200, 999, 999, 0.8)]
    with Server(lambda request: http_reply(said(*boxes))) as server:
        found = _ask(_asking(server)).detections
    assert [(one.x1_px, one.y1_px, one.x2_px, one.y2_px, one.score) for one in found] == [
        (300, 200, 320, 240, 0.8), (0, 10, 20, 40, 0.5)]


def test_connection_is_reused_and_reopened_after_the_server_closes_it():
    with Server(lambda request: GOOD) as server:
        detector = _asking(server)
        assert all(_ask(detector, seq=seq) for seq in range(1, 6)) and server.connections == 1
        server.answer = lambda request: http_reply(said(box()), headers=["Connection: close"])
        assert all(_ask(detector, seq=seq) for seq in range(6, 9)) and server.connections == 3
        server.answer = lambda request: GOOD
        assert _ask(detector, seq=9)
        port = server.port
        server.kill()
        server.start(port)
        assert _ask(detector, seq=10) and not detector.rejected, "the kept connection is over, another one is made"


def test_a_name_whose_first_address_is_dead_is_reached_at_its_second(monkeypatch):
    with Server(lambda request: GOOD) as server, socket.create_server(("127.0.0.2", server.port), backlog=0) as dead:
        filling = [socket.socket() for _ in range(3)]  # a full queue answers no more than a firewall
        for one in filling:
            one.setblocking(False)
            one.connect_ex(dead.getsockname())
        two = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, server.port)) for host in ("127.0.0.2", "127.0.0.1")]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: list(two))
        detector = _asking(server)
        began_s = time.monotonic()
        assert _ask(detector, seconds=2.0)
        assert time.monotonic() - began_s > 0.2, "the first was tried"
        server.answer = lambda request: http_reply(said(box()), headers=["Connection: close"])
        began_s = time.monotonic()
        assert all(_ask(detector, seconds=5.0, seq=seq) for seq in (2, 3))
        assert time.monotonic() - began_s < 2.0, "the one that was there is tried first"
        for one in filling:
            one.close()


def test_a_name_whose_first_address_is_of_a_family_that_this_machine_lacks_is_reached(monkeypatch):
    with Server(lambda request: GOOD) as server:
        lacking = (9999, socket.SOCK_STREAM, 6, "", ("::1", server.port, 0, 0))
        there = (socket.AF_INET, socket.SOCK_STREAM, 6, "", ("127.0.0.1", server.port))
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: [lacking, there])
        assert _ask(_asking(server))


class Pieces:
    """A connection that delivers a reply in pieces. As in the kernel, an acknowledgment without delay lasts briefly."""

    def __init__(self, pieces):
        self.pieces, self.is_quick = list(pieces), False
        self.settimeout = self.sendall = self.close = lambda *_: None

    def setsockopt(self, level, option, value):
        if (level, option) == (socket.IPPROTO_TCP, socket.TCP_QUICKACK):
            self.is_quick = bool(value)

    def recv_into(self, buffer):
        assert self.is_quick
        self.is_quick, piece = False, self.pieces.pop(0)
        buffer[: len(piece)] = piece
        return len(piece)


@pytest.mark.parametrize("size", [1, 7, 60, 1000])
def test_each_part_of_a_reply_is_acknowledged_immediately(size, monkeypatch):
    """Otherwise a server that sends head and body apart waits 40 ms in between, e.g. each `http.server` of Python."""
    connection = Pieces(GOOD[at : at + size] for at in range(0, len(GOOD), size))
    monkeypatch.setattr(http_client, "_connected", lambda *_: connection)
    exchange = HttpExchange("127.0.0.1", 1)
    assert exchange.post("/", {}, b"", within(2.0)).body == said(box()) and not connection.pieces


def test_unsolicited_reply_answers_no_later_frame():
    second_sent = threading.Event()

    def twice(request):
        yield http_reply(said(box(x1=1.0)))
        time.sleep(0.02)  # not in one piece with the first
        yield http_reply(said(box(x1=1.0)))
        second_sent.set()

    with Server(twice) as server:
        detector = _asking(server)
        assert _ask(detector, seq=1) and second_sent.wait(5)
        server.answer = lambda request: http_reply(said(box(x1=99.0)))
        assert [_ask(detector, seq=seq).detections[0].x1_px for seq in (2, 3, 4)] == [99.0] * 3
        assert server.connections == 2 and not detector.rejected


MILLION = b'{"width_px":320,"height_px":240,"boxes":[' + b",".join([b"{}"] * 1_000_000) + b"]}"
BOMB = gzip.compress(bytes(64 << 20), 1)
HOSTILE = {
    "empty": (http_reply(b""), "MALFORMED"),
    "no json": (http_reply(b"{"), "MALFORMED"),
    "html": (http_reply(b"<html>It works!</html>"), "MALFORMED"),
    "html error page": (http_reply(b"<html>502</html>", "502 Bad Gateway"), "REJECTED"),
    "redirect": (http_reply(b"", "302 Found", ["Location: http://127.0.0.1:1/"]), "REJECTED"),
    "list": (http_reply(b"[]"), "MALFORMED"),
    "nested": (http_reply(b"[" * 100_000), "MALFORMED"),
    "no boxes field of the right kind": (http_reply(said()[:-1] + b',"boxes":5}'), "MALFORMED"),
    "box of three": (http_reply(said({"label": "a", "score": 1, "x1_px": 1, "y1_px": 1, "x2_px": 9})), "MALFORMED"),
    "text for a number": (http_reply(said(box(x1="7"))), "MALFORMED"),
    "normalized": (http_reply(said(box(0.1, 0.2, 0.4, 0.6), box(0.2, 0.2, 0.9, 1.0))), "UNFIT"),
    "nan": (http_reply(said(box(x1=float("nan")))), "NOT_FINITE"),
    "infinite": (http_reply(said(box(x2=float("inf")))), "NOT_FINITE"),
    "score of two": (http_reply(said(box(score=2.0))), "MALFORMED"),
    "inside out": (http_reply(said(box(x1=200.0))), "MALFORMED"),
    "control characters": (http_reply(said(box(label="a\x1b[2J"))), "MALFORMED"),
    "sixty-five boxes": (http_reply(said(*[box()] * 65)), "TOO_MANY"),
    "a million boxes": (http_reply(MILLION), "TOO_LARGE"),
    "longer than declared": (http_reply(bytes(MAX_ANSWER_BYTES), length=10**12), "TOO_LARGE"),
    "a chunk of -1": ((b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n-1\r\n",
                       *[bytes(1 << 16)] * 64), "TOO_LARGE"),
    "endless": ((b"HTTP/1.1 200 OK\r\n\r\n", *[bytes(1 << 16)] * 64), "TOO_LARGE"),
    "endless chunks": ((b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n",
                        *[b"10000\r\n" + bytes(1 << 16) + b"\r\n"] * 64), "TOO_LARGE"),
    "bad chunk": (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", "MALFORMED"),
    "endless headers": (b"HTTP/1.1 200 OK\r\n" + b"A: b\r\n" * 5_000, "MALFORMED"),
    "one endless header": (b"HTTP/1.1 200 OK\r\nA: " + b"b" * 200_000, "MALFORMED"),
    "no http": (b"SSH-2.0-OpenSSH_9.6\r\n", "MALFORMED"),
    "gzip bomb": (http_reply(BOMB, headers=["Content-Encoding: gzip"]), "ENCODED"),
    "deflate": (http_reply(b"x", headers=["Content-Encoding: deflate"]), "ENCODED"),
    "other frame": (http_reply(said(box(), session="0000abcd", seq=99)), "OTHER_FRAME"),
    "other session": (http_reply(said(box(), session="0000ffff", seq=1)), "OTHER_FRAME"),
    "other size": (http_reply(said(box(), width_px=640, height_px=480)), "OTHER_SIZE"),
    "cut": (http_reply(said(box()))[:-9], "LATE"),
    "nothing": (None, "LATE"),
    "dripping": (lambda: (GOOD[at:at + 1] for at in range(len(GOOD)) if not time.sleep(0.02)), "LATE"),
    "a hundred continues": (b"HTTP/1.1 100 Continue\r\n\r\n" * 100_000, "TOO_LARGE"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_answer_is_rejected_and_counted_and_ends_nothing(name):
    reply, reason = HOSTILE[name]
    deadline_s = 0.3 if reason == "LATE" else 3.0  # what is rejected for its content must be read in time
    with Server(lambda request: reply() if callable(reply) else reply) as server:
        detector = _asking(server)
        times_s = []
        for _ in range(3 if reason == "LATE" else 1):  # the least, since a busy machine delays some
            began_s = time.monotonic()
            assert _ask(detector, seconds=deadline_s) is None
            times_s.append(time.monotonic() - began_s)
        assert min(times_s) < deadline_s + 0.3 and dict(detector.rejected) == {reason: len(times_s)}
        server.answer = lambda request: GOOD
        assert _ask(detector, seq=2), "the next answer counts again"
    lines = detector.notices()
    assert len(lines) == 2 and reason in lines[0] and "answers again" in lines[1]


@pytest.mark.own_process
def test_a_gzip_bomb_and_a_million_boxes_take_no_memory():
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    replies = iter([HOSTILE["gzip bomb"][0], HOSTILE["a million boxes"][0]] * 5)
    with Server(lambda request: next(replies)) as server:
        detector = _asking(server)
        for seq in range(1, 11):
            assert _ask(detector, seq=seq) is None
    assert sum(detector.rejected.values()) == 10
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 32_000


def test_invalid_image_is_not_sent():
    with Server(lambda request: GOOD) as server:
        detector = _asking(server)
        for jpeg in (b"", b"\xff\xd8", b"GIF89a", GREY_JPEG[:100]):
            assert _ask(detector, jpeg=jpeg) is None
        assert _ask(detector, width_px=640, height_px=480) is None
        assert detector.rejected == {"BAD_PICTURE": 5} and not server.requests


def test_missing_server_costs_no_time_and_is_tried_again():
    with Server(lambda request: GOOD) as server:
        port = server.port
        server.kill()
        detector = _asking(server)
        began_s = time.monotonic()
        assert [_ask(detector, seconds=5.0, seq=seq) for seq in range(1, 200)] == [None] * 199
        assert time.monotonic() - began_s < 1.0 and set(detector.rejected) == {"UNREACHABLE"}
        assert len(detector.notices()) < 5, "not a line for each frame"
        server.start(port)
        assert until(lambda: _ask(detector), 3 * RETRY_US / 1e6)


def test_killed_server_gives_no_answer_by_the_deadline_and_recovers():
    before = set(threading.enumerate())
    with Server(lambda request: GOOD) as server:
        port = server.port
        detector = HttpJpeg(HttpJpeg.Config(address=f"http+jpeg://127.0.0.1:{port}/"))
        try:
            assert _ask(detector)
            server.kill()
            times_s = []
            for seq in range(2, 12):
                began_s = time.monotonic()
                assert _ask(detector, seconds=0.1, seq=seq) is None
                times_s.append(time.monotonic() - began_s)
            assert sorted(times_s)[5] < 0.2, "most of them, since a busy machine delays some"
            server.start(port)
            assert until(lambda: _ask(detector, seconds=0.1), 3.0)
        finally:
            detector.close()
    assert not [one for one in set(threading.enumerate()) - before if one.name == "detector"]


def test_server_that_hangs_while_connecting_gives_no_answer_by_the_deadline():
    import socket

    with socket.create_server(("127.0.0.1", free_port()), backlog=0) as listener:  # always full: no process accepts
        port = listener.getsockname()[1]
        fill = [socket.socket() for _ in range(3)]
        for one in fill:
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", port))
        times_s = []
        for _ in range(3):  # the least, since a busy machine delays some
            detector = HttpJpeg(HttpJpeg.Config(address=f"http+jpeg://127.0.0.1:{port}/"))
            began_s = time.monotonic()
            assert _ask(detector, seconds=0.15) is None
            times_s.append(time.monotonic() - began_s)
            detector.close()
        assert min(times_s) < 0.3
        for one in fill:
            one.close()


@pytest.mark.parametrize(("address", "hint"), [
    ("http+jpeg://", "http+jpeg://127.0.0.1:8080/detect"), ("http+jpeg://host:0/x", "127.0.0.1:8080/detect"),
    ("http+jpeg://host:99999/", "8080"), ("http+jpeg://ho st/", "8080"), ("http+jpeg://h/a\r\nX: y", "8080"),
    ("oip+http://host", "names no model"), ("oip+http://host/a/b", "names no model"),
    ("oip+http://host/a b", "8000/ball"),
])
def test_invalid_address_gives_one_line_with_the_correct_form(address, hint):
    with pytest.raises(ConfigError) as error:
        parse_address(address)
    assert hint in str(error.value) and "\n" not in str(error.value)


def test_addresses_have_the_default_ports_of_servers():
    assert parse_address("oip+http://box/ball/3") == parse_address("oip+http://box:8000/ball/3")
    assert parse_address("oip+http://[::1]/ball").host == "::1"
    assert parse_address("http+jpeg://box").path == "/"
