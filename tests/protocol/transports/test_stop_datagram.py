"""The STOP datagram: its bytes, its HMAC, and when a sender counts a STOP as proven."""

import hmac

import pytest

from sightline.protocol.errors import ConfigError, RejectReason, WireError
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT, own_stop_addresses, stop_addresses
from sightline.protocol.transports.stop_datagram import (
    DATAGRAM_BYTES,
    NO_CHALLENGE,
    STATES,
    STOP_PORT,
    STOPPED,
    Kind,
    StopDatagram,
    StopRequests,
    check_hmac,
    pack_stop,
    unpack_stop,
)

SECRET, CHALLENGE, LATER = b"secret of this site", b"c" * 16, b"d" * 16
FULL = StopDatagram(Kind.ANSWER, "r1", 7, CHALLENGE, STOPPED, True, True, True, 2**63, 2**53)


def test_a_datagram_is_read_as_it_was_written():
    assert unpack_stop(pack_stop(FULL)) == FULL
    assert len(pack_stop(FULL, SECRET)) == len(pack_stop(StopDatagram(Kind.STOP, "r" * 32, 0))) == DATAGRAM_BYTES


def test_the_hmac_is_that_of_rfc_2104_over_everything_before_it():
    for secret in (SECRET, b"k" * 64, b"k" * 65):
        data = pack_stop(FULL, secret)
        assert data[80:] == hmac.digest(secret, data[:80], "sha256")
        check_hmac(data, secret)


@pytest.mark.parametrize("place", range(0, DATAGRAM_BYTES, 5))
def test_no_byte_can_be_changed_without_the_secret(place):
    data = bytearray(pack_stop(FULL, SECRET))
    data[place] ^= 1
    with pytest.raises(WireError, match="WRONG_KEY"):
        check_hmac(bytes(data), SECRET)


@pytest.mark.parametrize("length", [*range(0, 2001, 37), DATAGRAM_BYTES - 1, DATAGRAM_BYTES + 1, 2000])
def test_another_length_is_malformed(length):
    with pytest.raises(WireError, match="MALFORMED"):
        unpack_stop(pack_stop(FULL).ljust(2000, b"\0")[:length])


@pytest.mark.parametrize(("place", "byte", "reason"), [
    (0, 0, RejectReason.MALFORMED), (4, 2, RejectReason.UNSUPPORTED_VERSION), (5, 0, RejectReason.MALFORMED),
    (5, 4, RejectReason.MALFORMED), (6, len(STATES), RejectReason.MALFORMED), (8, 0xFF, RejectReason.MALFORMED),
])  # fmt: skip
def test_an_invalid_byte_has_its_reason(place, byte, reason):
    data = bytearray(pack_stop(FULL))
    data[place] = byte
    with pytest.raises(WireError) as error:
        unpack_stop(bytes(data))
    assert error.value.reason is reason


def test_the_port_is_the_next_one_above_that_of_the_link():
    assert stop_addresses([DEFAULT_ENDPOINT]) == [("127.0.0.1", STOP_PORT)]
    ends = ["tls/[::1]:7001#iface=lo", "ws://0.0.0.0:9090", "ws-legacy://0.0.0.0:9091", "tls/[::1]:7001"]
    assert stop_addresses(ends) == [("::1", 7002), ("0.0.0.0", 9091)]
    assert stop_addresses([]) == []


WIDE = "tcp/0.0.0.0:7447"


@pytest.mark.parametrize(("first", "second", "example"), [
    (DEFAULT_ENDPOINT, "tcp/0.0.0.0:7448", "tcp/0.0.0.0:7449"), (DEFAULT_ENDPOINT, "tls/[::]:7448", "tls/[::]:7449"),
    (WIDE, "wss://0.0.0.0:7448", "wss://0.0.0.0:7449"), (WIDE, "ws://[::]:7448/", "ws://[::]:7449/"),
])  # fmt: skip
def test_stop_port_is_not_that_of_discovery(first, second, example):
    with pytest.raises(ConfigError) as error:
        own_stop_addresses([first, second])
    assert str(error.value) == (f"port 7448 in {second}: its STOP port would be 7449/udp, which is that of discovery; "
                                f"use another port, e.g. {example}")


@pytest.mark.parametrize("listen", [
    [WIDE, "tcp/0.0.0.0:7449"], [WIDE, "tcp/127.0.0.1:7448"], [DEFAULT_ENDPOINT, "tcp/192.168.1.20:7448"],
    ["ws://0.0.0.0:7448"], [DEFAULT_ENDPOINT, "ws://0.0.0.0:7448"], ["tcp/[::1]:7447", "wss://[::]:7448"], [],
])  # fmt: skip
def test_stop_port_may_be_7449_where_discovery_does_not_use_it(listen):
    """A WebSocket endpoint, or one on loopback, switches no discovery on."""
    assert own_stop_addresses(listen) == stop_addresses(listen)


# --- the sender ----------------------------------------------------------------------------------------------------


def answer(request: bytes, secret=b"", **fields):
    """Return the answer of a receiver to `request`: stopped, unless `fields` state another thing."""
    asked = unpack_stop(request)
    usual = {"challenge": CHALLENGE, "state": STOPPED, "at_rest": True, "stored": True, "received": 5, "applied": 5}
    robot, counter = fields.pop("robot", asked.robot), fields.pop("counter", asked.counter)
    kind = fields.pop("kind", Kind.ANSWER)
    return pack_stop(StopDatagram(kind, robot, counter, **{**usual, **fields}), secret)


def test_a_stop_is_proven_by_state_wheels_and_number():
    requests = StopRequests("r1", b"", 100)
    [request] = requests.datagrams()
    assert not requests.is_stopped
    requests.on_datagram(answer(request))
    assert requests.is_stopped and requests.is_stored


@pytest.mark.parametrize("fields", [
    {"state": STATES.index("ACTIVE")}, {"state": 0}, {"at_rest": False}, {"applied": 4}, {"robot": "r2"},
    {"counter": 99}, {"counter": 100}, {"counter": 102}, {"kind": Kind.STOP}, {"received": 0, "applied": 0},
])  # fmt: skip
def test_an_answer_without_one_of_them_proves_nothing(fields):
    requests = StopRequests("r1", b"", 100)
    [request] = requests.datagrams()
    requests.on_datagram(answer(request, **fields))
    assert not requests.is_stopped


def test_a_state_from_before_this_stop_proves_nothing():
    """The robot was stopped, reset, and drives: the first answer still has the state from before."""
    requests = StopRequests("r1", b"", 100)
    [first], [second] = requests.datagrams(), requests.datagrams()
    requests.on_datagram(answer(first, received=5, applied=4))
    requests.on_datagram(answer(second, received=6, applied=4))
    assert not requests.is_stopped
    requests.on_datagram(answer(second, received=6, applied=5))
    assert requests.is_stopped


def test_a_stop_that_the_disk_lacks_is_stopped_but_not_stored():
    requests = StopRequests("r1", b"", 100)
    requests.on_datagram(answer(requests.datagrams()[0], stored=False))
    assert requests.is_stopped and not requests.is_stored


def test_with_a_secret_the_challenge_comes_first_and_is_in_the_stop():
    requests = StopRequests("r1", SECRET, 100)
    [query] = requests.datagrams()
    assert unpack_stop(query).challenge == NO_CHALLENGE
    assert requests.on_datagram(answer(query, SECRET, state=0, received=0, applied=0))
    [stop] = requests.datagrams()
    assert unpack_stop(stop).challenge == CHALLENGE
    check_hmac(stop, SECRET)
    assert not requests.on_datagram(answer(stop, SECRET)) and requests.is_stopped


@pytest.mark.parametrize("secret", [b"", b"another secret"])
def test_with_a_secret_an_answer_without_its_hmac_is_ignored(secret):
    requests = StopRequests("r1", SECRET, 100)
    assert not requests.on_datagram(answer(requests.datagrams()[0], secret))
    assert requests.answer is None


def test_a_robot_that_starts_again_is_stopped_with_its_new_challenge():
    requests = StopRequests("r1", SECRET, 100)
    requests.on_datagram(answer(requests.datagrams()[0], SECRET, received=0, applied=0))
    for _ in range(6):
        sent = requests.datagrams()
    query, stop = sent
    assert unpack_stop(query).challenge == NO_CHALLENGE and unpack_stop(stop).challenge == CHALLENGE
    assert requests.on_datagram(answer(query, SECRET, challenge=LATER, received=0, applied=0))
    assert unpack_stop(requests.datagrams()[0]).challenge == LATER


def test_a_number_of_an_earlier_receiver_proves_nothing():
    requests = StopRequests("r1", b"", 100)
    [first], [second] = requests.datagrams(), requests.datagrams()
    requests.on_datagram(answer(first, received=5, applied=0))
    requests.on_datagram(answer(second, challenge=LATER, received=9, applied=5))
    assert not requests.is_stopped


@pytest.mark.parametrize("secret", [b"", SECRET])
@pytest.mark.parametrize("standing_first", [False, True])
def test_of_two_robots_of_one_id_both_must_stop(secret, standing_first):
    """One stands, the other one drives: each answers for itself, and has numbers and a challenge of its own."""
    requests, order = StopRequests("r1", secret, 100), (LATER, CHALLENGE) if standing_first else (CHALLENGE, LATER)
    for turn in range(40):
        sent = requests.datagrams()
        for challenge in order:
            known = [one for one in sent if unpack_stop(one).challenge == challenge] or sent[:1]
            is_stopped = challenge == LATER or turn > 30
            requests.on_datagram(answer(known[0], secret, challenge=challenge, received=turn + 5, applied=turn + 5,
                                        at_rest=is_stopped))
        assert requests.is_stopped == requests.is_stored == (turn > 30)
        assert requests.is_latched
    requests.on_datagram(answer(sent[0], secret, challenge=LATER, received=99, applied=99, at_rest=False))
    assert not requests.is_stopped
    for _ in range(30):  # and then it is switched off
        requests.on_datagram(answer(requests.datagrams()[0], secret, received=99, applied=99))
    assert requests.is_stopped


def test_a_receiver_that_needs_the_secret_is_noticed():
    requests = StopRequests("r1", b"", 100)
    requests.on_datagram(answer(requests.datagrams()[0], keyed=True, state=0))
    assert requests.lacks_secret
