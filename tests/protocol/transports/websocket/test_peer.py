"""What waits for a peer without room: the newest of each place, and never a STOP that another request replaced."""

import random
import threading

import pytest

from sightline.protocol.channels import CHANNELS, DETECTIONS, FRAME, REPLY, REQUEST, SCAN, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.legacy_text import encode_picture
from sightline.protocol.messages import Request
from sightline.protocol.transports.endpoints import LegacyOptions
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.security import KNOWN_SOURCES
from sightline.protocol.transports.websocket.framing import SightlineV1
from sightline.protocol.transports.websocket.legacy import DriverSlot, LegacyClient, LegacyToVision
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.peer import MAX_UNKNOWN_SOURCES, Outbox, Publication
from tests.fixtures.links import until
from tests.fixtures.websocket import free_ws

VERBS = ("arm", "disarm", "stop", "reset", "acquire", "release")


def request(verb: str, number: int = 1, source: str = "teleop") -> Publication:
    return Publication(Message(REQUEST, source, b"", encode(Request(id=number, verb=verb))))


def taken(outbox: Outbox) -> list[Publication | str]:
    return list(iter(outbox.take, None))


def test_the_newest_and_the_most_urgent_first():
    outbox = Outbox()
    for number in b"123":
        for channel, source in ((SCAN, ""), (FRAME, ""), (REPLY, ""), (TWIST, "teleop"), (TWIST, "console")):
            outbox.put(Publication(Message(channel, source, b"", bytes([number]))))
    outbox.put_hello("old hello")
    outbox.put_hello("hello")
    assert outbox.waiting
    hello, *posts = taken(outbox)
    assert hello == "hello"
    assert [post.message for post in posts] == [
        Message(channel, source, b"", b"3")
        for channel, source in ((TWIST, "teleop"), (TWIST, "console"), (REPLY, ""), (FRAME, ""), (SCAN, ""))
    ]
    assert not outbox.waiting
    assert +outbox.dropped == {"scan": 2, "frame": 2, "reply": 2, "twist": 4}


def test_a_stop_is_replaced_by_nothing_but_a_stop_and_goes_first():
    outbox = Outbox()
    outbox.put(Publication(Message(TWIST, "teleop", b"", b"1|0")))
    for verb in ("reset", "stop", "arm", "acquire", "release", "disarm", "reset"):
        outbox.put(request(verb))
    outbox.put(request("stop", 2))
    got = [post.message for post in taken(outbox)]
    assert got[0] == request("stop", 2).message
    assert sorted(message.payload for message in got[1:]) == sorted(
        [b"1|0", *(request(verb).message.payload for verb in VERBS if verb != "stop")]
    )
    assert +outbox.dropped == {"request": 2}


@pytest.mark.parametrize("seed", range(5))
def test_however_requests_come_every_asker_s_stop_is_there(seed):
    dice, outbox, stopped = random.Random(seed), Outbox(), set()
    for number in range(200):
        source, verb = dice.choice(["teleop", "vision", "operator"]), dice.choice(VERBS)
        outbox.put(request(verb, number, source))
        stopped |= {source} if verb == "stop" else set()
    got = taken(outbox)
    assert {post.message.source for post in got[: len(stopped)]} == stopped
    assert all(b'"stop"' in post.message.payload for post in got[: len(stopped)])
    assert len(got) <= 3 * len(VERBS)  # bounded, however many are asked


def test_requests_that_cannot_be_read_share_one_place():
    outbox = Outbox()
    for payload in (b"", b"{}", b"stop", bytes(REQUEST.max_payload_bytes)):
        outbox.put(Publication(Message(REQUEST, "teleop", b"", payload)))
    assert [post.message.payload for post in taken(outbox)] == [bytes(REQUEST.max_payload_bytes)]


@pytest.mark.parametrize("channel", [one for one in CHANNELS.values() if one.passed_on], ids=lambda one: one.name)
def test_whoever_makes_up_sources_gets_few_places_and_takes_none_of_the_roles(channel):
    outbox = Outbox()
    for number in range(1000):
        outbox.put(Publication(Message(channel, f"s{number}", b"", b"old")))
    for source in KNOWN_SOURCES:
        outbox.put(Publication(Message(channel, source, b"", b"new")))
    outbox.put(Publication(Message(channel, "s0", b"", b"new")))  # it has its place
    assert +outbox.dropped == {channel.name: 1000 - MAX_UNKNOWN_SOURCES + 1}
    got = {post.message.source: post.message.payload for post in taken(outbox)}
    assert set(got) > KNOWN_SOURCES
    assert len(got) == MAX_UNKNOWN_SOURCES + len(KNOWN_SOURCES)
    assert got["s0"] == b"new"
    outbox.put(Publication(Message(channel, "s999", b"", b"new")))
    assert outbox.waiting  # places that were left are free again


def test_no_number_of_sources_keeps_a_request_back():
    outbox, count = Outbox(), 100
    for number in range(count):
        outbox.put(Publication(Message(DETECTIONS, f"s{number}", b"", b"")))
        outbox.put(request("stop", source=f"s{number}"))
    assert [post.message.channel for post in taken(outbox)][:count] == [REQUEST] * count


def test_a_publication_is_written_once_for_all_who_are_sent_the_same():
    post = Publication(Message(FRAME, "", b'{"v":1}', b"picture"))
    modern, other = SightlineV1("r1", ""), SightlineV1("r1", "")
    assert post.written(modern) is post.written(other)
    client = LegacyClient("here", DriverSlot(), print)
    lines, line = (LegacyToVision("r1", LegacyOptions(newlines=newlines), int, client) for newlines in (True, False))
    assert post.written(lines) == (encode_picture(b"picture"),)
    assert post.written(line) == (encode_picture(b"picture", False),)
    assert post.written(lines) is post.written(LegacyToVision("r1", LegacyOptions(), int, client))


def test_a_stop_reaches_a_robot_that_was_not_reading_whatever_was_asked_after_it():
    endpoint, go_on, asked = free_ws(), threading.Event(), []
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
