"""The queue for a peer without room: it keeps the newest of each place, and no other request replaces a STOP."""

import random
import threading

import pytest

from sightline.protocol.channels import CHANNELS, DETECTIONS, FRAME, KNOWN_SOURCES, REPLY, REQUEST, SCAN, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.messages import Request
from sightline.protocol.transports.endpoints import LegacyOptions
from sightline.protocol.transports.link import MAX_UNKNOWN_SOURCES, Message, OutgoingQueue
from sightline.protocol.transports.websocket.framing import SightlineV1
from sightline.protocol.transports.websocket.legacy import DriverSlot, LegacyClient, LegacyToVision
from sightline.protocol.transports.websocket.legacy_text import encode_picture
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.peer import Publication
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint

Queue = OutgoingQueue[Publication | str]
VERBS = ("arm", "disarm", "stop", "reset", "acquire", "release")


def request(verb: str, number: int = 1, source: str = "teleop") -> Publication:
    return Publication(Message(REQUEST, source, b"", encode(Request(id=number, verb=verb))))


def taken(queue: Queue) -> list[Publication | str]:
    return list(iter(queue.take, None))


def put(queue: Queue, post: Publication) -> bool:
    return queue.put(post.message, post)


def test_queue_holds_the_newest_and_sends_the_most_urgent_first():
    queue = OutgoingQueue()
    for number in b"123":
        for channel, source in ((SCAN, ""), (FRAME, ""), (REPLY, ""), (TWIST, "teleop"), (TWIST, "console")):
            put(queue, Publication(Message(channel, source, b"", bytes([number]))))
    queue.put_first("old hello")
    queue.put_first("hello")
    assert len(queue)
    hello, *posts = taken(queue)
    assert hello == "hello"
    assert [post.message for post in posts] == [
        Message(channel, source, b"", b"3")
        for channel, source in ((TWIST, "teleop"), (TWIST, "console"), (REPLY, ""), (FRAME, ""), (SCAN, ""))
    ]
    assert not len(queue)
    assert +queue.dropped == {"scan": 2, "frame": 2, "reply": 2, "twist": 4}


def test_only_a_stop_replaces_a_stop_and_it_leaves_first():
    queue = OutgoingQueue()
    put(queue, Publication(Message(TWIST, "teleop", b"", b"1|0")))
    for verb in ("reset", "stop", "arm", "acquire", "release", "disarm", "reset"):
        put(queue, request(verb))
    put(queue, request("stop", 2))
    got = [post.message for post in taken(queue)]
    assert got[0] == request("stop", 2).message
    assert sorted(message.payload for message in got[1:]) == sorted(
        [b"1|0", *(request(verb).message.payload for verb in VERBS if verb != "stop")]
    )
    assert +queue.dropped == {"request": 2}


@pytest.mark.parametrize("seed", range(5))
def test_every_stop_stays_queued_in_any_order_of_requests(seed):
    dice, queue, stopped = random.Random(seed), OutgoingQueue(), set()
    for number in range(200):
        source, verb = dice.choice(["teleop", "vision", "operator"]), dice.choice(VERBS)
        put(queue, request(verb, number, source))
        stopped |= {source} if verb == "stop" else set()
    got = taken(queue)
    assert {post.message.source for post in got[: len(stopped)]} == stopped
    assert all(b'"stop"' in post.message.payload for post in got[: len(stopped)])
    assert len(got) <= 3 * len(VERBS)  # bounded for any number of requests


def test_requests_that_cannot_be_read_share_one_place():
    queue = OutgoingQueue()
    for payload in (b"", b"{}", b"stop", bytes(REQUEST.max_payload_bytes)):
        put(queue, Publication(Message(REQUEST, "teleop", b"", payload)))
    assert [post.message.payload for post in taken(queue)] == [bytes(REQUEST.max_payload_bytes)]


@pytest.mark.parametrize("channel", [one for one in CHANNELS.values() if one.passed_on], ids=lambda one: one.name)
def test_invented_sources_get_few_places_and_none_of_a_role(channel):
    queue = OutgoingQueue()
    for number in range(1000):
        put(queue, Publication(Message(channel, f"s{number}", b"", b"old")))
    for source in KNOWN_SOURCES:
        put(queue, Publication(Message(channel, source, b"", b"new")))
    put(queue, Publication(Message(channel, "s0", b"", b"new")))  # it has its place
    assert +queue.dropped == {channel.name: 1000 - MAX_UNKNOWN_SOURCES + 1}
    got = {post.message.source: post.message.payload for post in taken(queue)}
    assert set(got) > KNOWN_SOURCES
    assert len(got) == MAX_UNKNOWN_SOURCES + len(KNOWN_SOURCES)
    assert got["s0"] == b"new"
    put(queue, Publication(Message(channel, "s999", b"", b"new")))
    assert len(queue)  # places that were left are free again


def test_many_sources_do_not_delay_a_request():
    queue, count = OutgoingQueue(), 100
    for number in range(count):
        put(queue, Publication(Message(DETECTIONS, f"s{number}", b"", b"")))
        put(queue, request("stop", source=f"s{number}"))
    assert [post.message.channel for post in taken(queue)][:count] == [REQUEST] * count


def test_publication_is_encoded_once_for_equal_peers():
    post = Publication(Message(FRAME, "", b'{"v":1}', b"picture"))
    modern, other = SightlineV1("r1", ""), SightlineV1("r1", "")
    assert post.written(modern) is post.written(other)
    client = LegacyClient("here", DriverSlot(), print)
    lines, line = (LegacyToVision("r1", LegacyOptions(newlines=newlines), int, client) for newlines in (True, False))
    assert post.written(lines) == (encode_picture(b"picture"),)
    assert post.written(line) == (encode_picture(b"picture", False),)
    assert post.written(lines) is post.written(LegacyToVision("r1", LegacyOptions(), int, client))


def test_stop_reaches_a_robot_that_was_not_reading_despite_later_requests():
    endpoint, go_on, asked = free_endpoint("ws://"), threading.Event(), []
    with open_websocket("r1", listen=endpoint) as robot, open_websocket("r1", connect=endpoint, role="teleop") as peer:
        robot.subscribe(STATUS, lambda _message: None)
        robot.subscribe(TWIST, lambda _message: go_on.wait(5) and None)  # as if its process stood still
        robot.subscribe(REQUEST, asked.append)
        assert until(lambda: peer.has_listener(REQUEST) and peer.has_listener(TWIST))
        while not peer.dropped["twist"]:  # until not even the kernel takes more
            peer.publish(TWIST, bytes(500), b"0|0")
        for number, verb in enumerate(("arm", "stop", "reset", "acquire", "arm")):
            peer.publish(REQUEST, b"", encode(Request(id=number, verb=verb)))
        go_on.set()
        assert until(lambda: len(asked) == 4)
        assert b'"stop"' in asked[0].payload
