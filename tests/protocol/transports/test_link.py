"""The promises of every `Link`, over every transport. A transport joins by a rig in `tests/fixtures/links.py`."""

import itertools
import random
import time
from collections.abc import Iterator

import pytest

from sightline.protocol import log
from sightline.protocol.channels import ACK, FRAME, MAX_HEADER_BYTES, REQUEST, STATUS, TWIST
from sightline.protocol.log import faults
from sightline.protocol.transports.link import INEXACT_KEY, OVERSIZE, LinkRules, Message
from tests.fixtures.links import RIGS, MemoryRig
from tests.fixtures.websocket import resident_kib


@pytest.fixture(params=RIGS, ids=RIGS)
def rig(request: pytest.FixtureRequest) -> Iterator[MemoryRig]:
    rig = RIGS[request.param]()
    yield rig
    rig.close()


def _pair(rig):
    """Return a robot, its vision peer, and the slots of the frames and twists that they receive."""
    robot, peer = rig.robot(), rig.peer()
    frames, twists = peer.latest(FRAME), robot.latest(TWIST)
    assert rig.until(lambda: robot.has_listener(FRAME) and peer.has_listener(TWIST))
    return robot, peer, frames, twists


def _take(rig, slot) -> Message:
    got = []
    assert rig.until(lambda: got.append(slot.take()) or got[-1] is not None)
    return got[-1]


def _check_arrival(rig, sender, slot, messages) -> None:
    """Send each message until it arrives, since a link of a busy machine drops some; nothing else may arrive."""
    arrived = [None]
    for message in messages:
        def comes(message=message) -> bool:
            assert sender.publish(message.channel, message.header, message.payload)
            rig.until(lambda: arrived.append(slot.take()) or arrived[-1] is not None, 1.0)
            return arrived[-1] == message

        assert rig.until(comes)
        assert all(one in (None, *messages) for one in arrived)


def test_header_and_payload_arrive_as_they_were_sent(rig):
    robot, peer, frames, twists = _pair(rig)
    acks = robot.latest(ACK)
    assert rig.until(lambda: peer.has_listener(ACK))
    dice = random.Random(5)
    sizes = (0, 1, 2, 63, 64, 65, 1_000, 65_535, 65_536, 400_000, FRAME.max_payload_bytes)
    _check_arrival(rig, robot, frames, [
        Message(FRAME, "", dice.randbytes(dice.randint(1, MAX_HEADER_BYTES)), dice.randbytes(size)) for size in sizes
    ])
    headers = (b"", b"{}", dice.randbytes(MAX_HEADER_BYTES))
    _check_arrival(rig, peer, twists, [Message(TWIST, "vision", header, b"0|0") for header in headers])
    _check_arrival(rig, peer, acks, [Message(ACK, "vision", b"{}", b"")])


def test_source_may_be_given_instead_of_the_role(rig):
    _, peer, _, twists = _pair(rig)
    peer.publish(TWIST, b"", b"0|0", source="guest")
    assert _take(rig, twists).source == "guest"


def test_messages_keep_their_order(rig):
    robot, peer, _, _ = _pair(rig)
    got: list[int] = []
    peer.subscribe(STATUS, lambda message: got.append(int(message.payload)))
    assert rig.until(lambda: robot.has_listener(STATUS))
    for number in range(300):
        robot.publish(STATUS, b"", b"%d" % number)
        rig.wait(0.002)
    more = itertools.count(300)  # on a busy machine any message may be dropped, the last one too
    assert rig.until(lambda: robot.publish(STATUS, b"", b"%d" % next(more)) and got and got[-1] >= 300)
    assert got == sorted(set(got))
    assert sum(number < 300 for number in got) > 200


def test_newest_wins_with_a_consumer_of_200_ms(rig):
    """Beside other tests a frame may be on its way for long: what counts is the newest that has arrived."""
    _check_newest_wins(rig, newest=lambda _sent, arrived: arrived, least_dropped=8)


@pytest.mark.alone
def test_at_most_one_frame_is_on_its_way_to_a_slow_consumer(rig):
    _check_newest_wins(rig, newest=lambda sent, _arrived: sent, least_dropped=30)


def _check_newest_wins(rig, newest, least_dropped) -> None:
    robot, peer, frames, _ = _pair(rig)
    arrived, taken, behind = [0], 0, []
    peer.subscribe(FRAME, lambda message: arrived.append(int(message.payload.rstrip(b"\0"))))
    for number in range(43):  # 30 frames a second for 1.4 s
        robot.publish(FRAME, b"", b"%d" % number + bytes(50_000))
        rig.wait(1 / 30)
        if number % 6 == 5:
            wanted, message = newest(number, arrived[-1]), frames.take()
            taken = int(message.payload.rstrip(b"\0")) if message else taken
            behind.append(wanted - taken)
    assert len(behind) == 7
    assert max(behind) <= 1
    assert frames.dropped >= least_dropped, "frames are replaced while they wait"


@pytest.mark.own_process
def test_a_consumer_that_never_takes_costs_no_memory(rig):
    robot, _, frames, _ = _pair(rig)
    before_kib = resident_kib()
    for number in range(300):  # 90 MB
        robot.publish(FRAME, b"", number.to_bytes(2) + bytes(300_000))
        rig.wait(0.004)
    assert rig.until(lambda: frames.dropped > 200)
    assert resident_kib() - before_kib < 25_000


def test_callback_that_raises_does_not_end_the_link(rig, caplog, monkeypatch):
    monkeypatch.setattr(log, "_kinds", set())
    before = faults()["callback"]
    robot, peer, _, _ = _pair(rig)
    calls: list[bytes] = []

    def raises(message: Message) -> None:
        calls.append(message.payload)
        raise RuntimeError("from a callback")

    peer.subscribe(STATUS, raises)
    beside = peer.latest(STATUS)
    assert rig.until(lambda: robot.has_listener(STATUS))
    for text in (b"1", b"2", b"3"):
        robot.publish(STATUS, b"", text)
        assert _take(rig, beside).payload == text
    assert rig.until(lambda: faults()["callback"] == before + 3)
    assert calls == [b"1", b"2", b"3"]
    (record,) = [one for one in caplog.records if "callback" in one.message]
    assert record.message == "callback status raised RuntimeError: from a callback" and record.exc_info


WRONG_KEYS = (
    "**",
    "sightline/**",
    "sightline/*/twist/vision",
    "sightline/r1/twist/*",
    "sightline/r1/twist/VISION",
    "sightline/r1/twist/v-1",
    "sightline/r1/twist",
    "sightline/r1/twist/vision/deeper",
    "sightline/r2/twist/vision",
    "starline/r1/twist/vision",
)


def test_only_the_exact_key_is_delivered(rig):
    robot, _, frames, twists = _pair(rig)
    for key in WRONG_KEYS:
        rig.stranger_puts(key, b"", b"1|1")
    rig.stranger_puts("sightline/r1/twist/guest", b"", b"0|0")
    assert _take(rig, twists) == Message(TWIST, "guest", b"", b"0|0")
    assert twists.dropped == 0
    assert frames.take() is None
    assert robot.rejected[INEXACT_KEY] >= 5


def test_oversize_is_rejected_at_both_ends(rig):
    robot, peer, _, twists = _pair(rig)
    for header, payload in ((bytes(MAX_HEADER_BYTES + 1), b"0|0"), (b"", bytes(TWIST.max_payload_bytes + 1))):
        with pytest.raises(ValueError, match="at most"):
            peer.publish(TWIST, header, payload)
        rig.stranger_puts("sightline/r1/twist/vision", header, payload)
    assert rig.until(lambda: robot.rejected[OVERSIZE] == 2)
    assert twists.take() is None


def test_has_listener_follows_the_subscriptions(rig):
    robot, peer = rig.robot(), rig.peer()
    assert rig.until(lambda: peer.connected)
    assert not robot.has_listener(FRAME)
    peer.latest(FRAME)
    assert rig.until(lambda: robot.has_listener(FRAME))
    assert not robot.has_listener(STATUS)
    peer.close()
    assert rig.until(lambda: not robot.has_listener(FRAME))


def test_ignored_channel_ends_and_can_be_subscribed_again(rig):
    robot, peer, frames, _ = _pair(rig)
    second = peer.latest(FRAME)
    peer.unsubscribe(FRAME)
    peer.unsubscribe(STATUS)  # what was never subscribed to
    assert rig.until(lambda: not robot.has_listener(FRAME))
    robot.publish(FRAME, b"", b"1")
    rig.wait(0.1)
    assert frames.take() is None and second.take() is None
    again = peer.latest(FRAME)
    assert rig.until(lambda: robot.has_listener(FRAME))
    robot.publish(FRAME, b"", b"2")
    assert _take(rig, again).payload == b"2" and frames.take() is None


def test_link_does_not_receive_its_own_messages(rig):
    robot, _, frames, _ = _pair(rig)
    own = robot.latest(FRAME)
    robot.publish(FRAME, b"", b"1")
    assert _take(rig, frames).payload == b"1"
    assert own.take() is None


def test_every_peer_receives_and_other_robots_do_not(rig):
    robot, _, frames, _ = _pair(rig)
    viewer, stranger = rig.peer("viewer"), rig.peer("viewer", robot="r2")
    seen, foreign = viewer.latest(FRAME), stranger.latest(FRAME)
    assert rig.until(lambda: rig.wait(0.02) or (robot.publish(FRAME, b"", b"1") and seen.take()), 2)
    assert _take(rig, frames).payload == b"1"
    assert foreign.take() is None


def test_restarted_peer_sends_and_receives_again(rig):
    robot, peer, _, twists = _pair(rig)
    for round_number in range(3):
        peer.close()
        assert rig.until(lambda: not robot.has_listener(FRAME))
        peer = rig.peer()
        frames = peer.latest(FRAME)
        assert rig.until(lambda: robot.has_listener(FRAME) and peer.has_listener(TWIST))  # noqa: B023
        robot.publish(FRAME, b"", b"%d" % round_number)
        peer.publish(TWIST, b"", b"%d|0" % round_number)
        assert _take(rig, frames).payload == b"%d" % round_number
        assert _take(rig, twists).payload == b"%d|0" % round_number


def test_restarted_robot_sends_and_receives_again(rig):
    robot, peer, frames, _ = _pair(rig)
    for round_number in range(2):
        robot.close()
        assert rig.until(lambda: not peer.has_listener(TWIST))
        rig.wait(rig.restart_s)
        robot = rig.robot()
        twists = robot.latest(TWIST)
        assert rig.until(lambda: robot.has_listener(FRAME) and peer.has_listener(TWIST))  # noqa: B023
        robot.publish(FRAME, b"", b"%d" % round_number)
        peer.publish(TWIST, b"", b"%d|0" % round_number)
        assert _take(rig, frames).payload == b"%d" % round_number
        assert _take(rig, twists).payload == b"%d|0" % round_number


def test_close_is_quick_idempotent_and_final(rig):
    robot, peer, frames, _ = _pair(rig)
    begin_s = time.monotonic()
    for link in (robot, peer, robot, peer):
        link.close()
    assert time.monotonic() - begin_s < 2
    assert not robot.publish(FRAME, b"", b"late")
    assert not robot.has_listener(FRAME)
    rig.wait(0.02)
    assert frames.take() is None


def test_close_inside_a_callback_does_not_hang(rig):
    robot, peer, _, _ = _pair(rig)
    took_s: list[float] = []

    def close(message: Message) -> None:
        begin_s = time.monotonic()
        peer.close()
        took_s.append(time.monotonic() - begin_s)

    peer.subscribe(STATUS, close)
    assert rig.until(lambda: robot.has_listener(STATUS))
    robot.publish(STATUS, b"", b"1")
    assert rig.until(lambda: took_s and not robot.has_listener(FRAME))
    assert took_s[0] < 0.5
    robot.publish(FRAME, b"", b"1")


def test_publish_without_a_peer_returns_false(rig):
    robot = rig.robot()
    peer = rig.peer()
    assert rig.until(lambda: robot.connected and peer.connected)
    assert robot.publish(STATUS, b"", b"{}")
    with pytest.raises(ValueError):
        robot.publish(REQUEST, b"", b"{}")  # towards the robot, but no source


@pytest.mark.parametrize("key", ["sightline/r2/twist/vision", "sightline/r1/ack/vision", "sightline/r1/twist/*", ""])
def test_the_rules_reject_a_key_that_is_not_of_the_robot_and_channel(key):
    """Directly, because a transport's own matching may already keep such keys away."""
    rules, got = LinkRules("r1"), []
    rules.deliver(TWIST, key, b"", b"0|0", got.append)
    rules.deliver(TWIST, "sightline/r1/twist/vision", b"", b"0|0", got.append)
    assert rules.rejected == {INEXACT_KEY: 1}
    assert got == [Message(TWIST, "vision", b"", b"0|0")]
