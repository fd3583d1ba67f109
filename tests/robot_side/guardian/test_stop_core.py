"""Logic of the STOP receiver and of the forwarder beside a router."""

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.transports.stop_datagram import (
    NO_CHALLENGE,
    STATES,
    STOPPED,
    Kind,
    StopDatagram,
    StopRequests,
    challenge_of,
    check_hmac,
    pack_stop,
    unpack_stop,
)
from sightline.robot_side.guardian.stop_core import (
    MAX_OPERATORS,
    MAX_PLACES,
    MAX_ROBOTS,
    MAX_WAITING,
    DriverReport,
    ForwarderCore,
    IgnoredDatagrams,
    ReceiverCore,
    Registration,
    pack_report,
    unpack_ignored,
    unpack_number,
)

SECRET, CHALLENGE = b"secret", b"c" * 16
FIRST = 1000
"""Number of the STOPs before the first."""


def receiver(secret=b""):
    return ReceiverCore("r1", secret, CHALLENGE, FIRST)


def send(core, now_us=0, secret=b"", **fields):
    """Send a STOP; return the answer."""
    one = StopDatagram(**{"kind": Kind.STOP, "robot": "r1", "counter": 7, **fields})
    data = pack_stop(one, secret)
    reply = core.on_stop(data, one, now_us)
    assert len(reply) <= len(data)
    return unpack_stop(reply)


def report(core, now_us, applied=0, state="STOPPED", at_rest=True, stored=True):
    core.on_report(pack_report(DriverReport(applied, state, at_rest, stored)), now_us)


def number(core, now_us):
    packet = core.packet(now_us)
    return packet and unpack_number(packet) - FIRST


def test_a_stop_is_answered_at_once_and_forwarded():
    core = receiver()
    got = send(core, counter=42)
    assert (got.kind, got.counter, got.received, got.state) == (Kind.ANSWER, 42, FIRST + 1, 0)
    assert number(core, 0) == 1


def test_an_answer_has_the_reported_state():
    core = receiver()
    report(core, 1000, FIRST, "ACTIVE", at_rest=False, stored=False)
    got = send(core, 2000)
    assert (got.state, got.at_rest, got.stored) == (STATES.index("ACTIVE"), False, False)
    report(core, 3000, FIRST + 1)
    got = send(core, 4000)
    assert (got.state, got.at_rest, got.stored, got.applied) == (STOPPED, True, True, FIRST + 1)


def test_a_silent_driver_process_has_no_state():
    core = receiver()
    report(core, 0, FIRST)
    assert send(core, 500_000).state == STOPPED
    got = send(core, 500_001)
    assert (got.state, got.at_rest) == (0, False)


def test_one_stop_is_in_flight_and_the_newest_follows_it():
    core = receiver()
    for _ in range(1000):
        send(core)
    assert number(core, 0) == 1000
    send(core)
    assert number(core, 1000) is None
    report(core, 2000, FIRST + 1000)
    assert number(core, 2000) == 1001
    report(core, 3000, FIRST + 1001)
    assert number(core, 3000) is None


def test_a_stop_that_a_dead_driver_process_took_with_it_is_sent_to_the_next():
    core = receiver()
    send(core)
    assert number(core, 0) == 1
    report(core, 49_999)
    assert number(core, 49_999) is None
    assert number(core, 10_000_000) is None  # nothing lives: the packet waits in the socket
    report(core, 10_000_000)
    assert number(core, 10_000_000) == 1


def test_a_new_driver_process_does_not_receive_a_stop_that_an_earlier_one_applied():
    """It was reset in between."""
    core = receiver()
    send(core)
    number(core, 0)
    report(core, 1000, FIRST + 1)
    report(core, 9_000_000, 0, "DISARMED")
    assert number(core, 9_000_000) is None
    got = send(core, 9_000_000)
    assert got.applied < got.received and number(core, 9_000_000) == 2


@pytest.mark.parametrize(("fields", "reason"), [
    ({"robot": "r2"}, RejectReason.OTHER_ROBOT),
    ({"challenge": b"x" * 16, "secret": SECRET}, RejectReason.OTHER_SESSION),
    ({"challenge": CHALLENGE}, RejectReason.WRONG_KEY),
    ({"challenge": CHALLENGE, "secret": b"another"}, RejectReason.WRONG_KEY),
    ({"robot": "r2", "challenge": CHALLENGE, "secret": SECRET}, RejectReason.OTHER_ROBOT),
])  # fmt: skip
def test_an_invalid_stop_is_ignored(fields, reason):
    core = receiver(SECRET)
    with pytest.raises(WireError) as error:
        send(core, **fields)
    assert error.value.reason is reason and number(core, 0) is None


@pytest.mark.parametrize("secret", [b"", SECRET])
@pytest.mark.parametrize("kind", [Kind.ANSWER, Kind.REGISTER])
def test_signed_datagram_of_another_kind_stops_nothing(kind, secret):
    core = receiver(secret)
    with pytest.raises(WireError, match="MALFORMED"):
        send(core, secret=secret, kind=kind, challenge=CHALLENGE)
    assert number(core, 0) is None


def test_answer_that_a_peer_without_keys_sends_back_stops_nothing():
    core = receiver(SECRET)
    query = StopDatagram(Kind.STOP, "r1", 7)
    reply = core.on_stop(pack_stop(query), query, 0)
    with pytest.raises(WireError, match="MALFORMED"):
        core.on_stop(reply, unpack_stop(reply), 1)
    assert core.packet(1) is None


def test_without_keys_a_stop_for_another_robot_is_ignored_and_any_other_is_valid():
    core = receiver()
    with pytest.raises(WireError, match="OTHER_ROBOT"):
        send(core, robot="r11")
    send(core, challenge=b"x" * 16, secret=b"of an operator with keys")
    assert number(core, 0) == 1


def test_a_request_for_the_challenge_stops_nothing_and_shows_no_state():
    core = receiver(SECRET)
    report(core, 0, FIRST)
    data = pack_stop(one := StopDatagram(Kind.STOP, "r1", 7))
    reply = core.on_stop(data, one, 0)
    check_hmac(reply, SECRET)
    got = unpack_stop(reply)
    assert (got.challenge, got.keyed, got.state, got.received, got.applied) == (CHALLENGE, True, 0, 0, 0)
    assert number(core, 0) is None


def test_with_keys_a_stop_of_this_start_is_applied_and_its_answer_is_signed():
    core = receiver(SECRET)
    one = StopDatagram(Kind.STOP, "r1", 7, CHALLENGE)
    check_hmac(core.on_stop(pack_stop(one, SECRET), one, 0), SECRET)
    assert number(core, 0) == 1


@pytest.mark.parametrize("address", ["192.168.1.7", "fe80::1%eth0"])
def test_ignored_datagrams_are_reported_once_a_second_until_there_was_room(address):
    ignored, sent, has_room = IgnoredDatagrams(), [], False
    for reason in ("MALFORMED", "OTHER_ROBOT", "MALFORMED"):
        ignored.add(WireError(RejectReason(reason), ""), address)

    def send(packet):
        sent.append(unpack_ignored(packet))
        return has_room

    for now_us, count in ((0, 1), (999_999, 1), (1_000_000, 2)):
        ignored.report(send, now_us)
        assert len(sent) == count
    has_room = True
    for now_us in (2_000_000, 3_000_000):
        ignored.report(send, now_us)
    assert sent == [({"MALFORMED": 2, "OTHER_ROBOT": 1}, address)] * 3, "none after there was room"


# --- the forwarder -------------------------------------------------------------------------------------------------


ROBOT, OPERATOR = (3, ("10.0.0.1", 50000)), (3, ("10.0.0.9", 60000))


def stop_of(robot="r1", counter=7, secret=b""):
    return pack_stop(StopDatagram(Kind.STOP, robot, counter), secret)


SIGNED = stop_of(secret=SECRET)


def register(core, robot="r1", origin=ROBOT, now_us=0):
    return core.on_datagram(Registration(robot, b"", 5).datagram(), origin, now_us)


def test_a_stop_reaches_a_registered_robot_and_its_answer_the_operator():
    core = ForwarderCore(b"", CHALLENGE)
    assert [place for _, place in register(core)] == [ROBOT]
    assert core.on_datagram(stop_of(), OPERATOR, 0) == [(stop_of(), ROBOT)]
    reply = pack_stop(StopDatagram(Kind.ANSWER, "r1", 7))
    assert core.on_datagram(reply, ROBOT, 0) == [(reply, OPERATOR)]


@pytest.mark.parametrize(("reply", "origin"), [
    (StopDatagram(Kind.ANSWER, "r1", 8), ROBOT), (StopDatagram(Kind.ANSWER, "r2", 7), ROBOT),
    (StopDatagram(Kind.ANSWER, "r1", 7), OPERATOR),
])  # fmt: skip
def test_another_answer_goes_nowhere(reply, origin):
    core = ForwarderCore(b"", CHALLENGE)
    register(core)
    core.on_datagram(stop_of(), OPERATOR, 0)
    assert core.on_datagram(pack_stop(reply), origin, 0) == []


def test_a_stop_for_an_unknown_robot_is_ignored():
    with pytest.raises(WireError, match="OTHER_ROBOT"):
        ForwarderCore(b"", CHALLENGE).on_datagram(stop_of(), OPERATOR, 0)


def test_two_robots_with_one_id_both_receive_a_stop():
    core = ForwarderCore(b"", CHALLENGE)
    other = (3, ("10.0.0.2", 1))
    register(core)
    register(core, origin=other)
    assert [place for _, place in core.on_datagram(stop_of(), OPERATOR, 0)] == [ROBOT, other]


def test_a_robot_that_still_registers_is_not_pushed_out():
    core = ForwarderCore(b"", CHALLENGE)
    register(core)
    for number in range(2 * MAX_PLACES):
        register(core, origin=(3, (f"10.0.1.{number}", 1)), now_us=number)
    assert ROBOT in [place for _, place in core.on_datagram(stop_of(), OPERATOR, 100)]
    register(core, now_us=4_000_000)
    register(core, origin=(3, ("10.0.2.1", 1)), now_us=4_000_000)
    places = [place for _, place in core.on_datagram(stop_of(), OPERATOR, 4_000_000)]
    assert ROBOT in places and (3, ("10.0.2.1", 1)) in places and len(places) == MAX_PLACES


def test_robots_and_waiting_operators_are_bounded():
    core = ForwarderCore(b"", CHALLENGE)
    register(core, "last", now_us=0)
    for number in range(MAX_ROBOTS + 10):
        register(core, f"r{number}", now_us=1)
    assert len(core._robots) == MAX_ROBOTS and "last" in core._robots
    register(core, "late", now_us=5_000_000)
    assert "late" in core._robots and len(core._robots) == MAX_ROBOTS
    for host in range(MAX_OPERATORS + 10):
        for counter in range(MAX_WAITING + 10):
            core.on_datagram(stop_of("late", counter), (3, (str(host), 1)), 5_000_000)
    assert [len(stops) for stops in core._waiting.values()] == [MAX_WAITING] * MAX_OPERATORS


def test_a_flood_from_other_addresses_displaces_no_operator():
    core = ForwarderCore(b"", CHALLENGE)
    register(core)
    core.on_datagram(stop_of(), OPERATOR, 0)
    for counter in range(100, 100 + 2 * MAX_WAITING):
        for host in range(MAX_OPERATORS - 1):
            core.on_datagram(stop_of("r1", counter), (3, (str(host), counter)), 0)
    reply = pack_stop(StopDatagram(Kind.ANSWER, "r1", 7))
    assert core.on_datagram(reply, ROBOT, 0) == [(reply, OPERATOR)]


def test_an_operator_that_still_sends_is_not_the_oldest():
    core = ForwarderCore(b"", CHALLENGE)
    register(core)
    for host in range(2 * MAX_OPERATORS):
        core.on_datagram(stop_of(), OPERATOR, 0)
        core.on_datagram(stop_of("r1", 8), (3, (str(host), 1)), 0)
    assert OPERATOR[1][0] in core._waiting and len(core._waiting) == MAX_OPERATORS


def test_with_keys_only_a_valid_hmac_is_forwarded_and_waits():
    core = ForwarderCore(SECRET, CHALLENGE)
    registered(core, Registration("r1", SECRET, 5), ROBOT)
    with pytest.raises(WireError, match="WRONG_KEY"):
        core.on_datagram(stop_of(secret=b"another"), OPERATOR, 0)
    assert not core._waiting
    assert core.on_datagram(SIGNED, OPERATOR, 0) == [(SIGNED, ROBOT)]


def test_with_keys_an_operator_without_the_secret_gets_to_know_it():
    core, sender = ForwarderCore(SECRET, CHALLENGE), StopRequests("r1", b"", 7)
    registered(core, Registration("r1", SECRET, 5), ROBOT)
    [(reply, place)] = core.on_datagram(*sender.datagrams(), OPERATOR, 0)
    assert place == OPERATOR and not core._waiting
    sender.on_datagram(reply)
    assert sender.lacks_secret and not sender.is_latched
    with pytest.raises(WireError, match="WRONG_KEY"):
        check_hmac(reply, SECRET)  # it must not count for a sender with the secret


def test_with_keys_a_robot_registers_by_the_challenge_of_the_router():
    core, registration = ForwarderCore(SECRET, CHALLENGE), Registration("r1", SECRET, 5)
    [(reply, _)] = core.on_datagram(registration.datagram(), ROBOT, 0)
    with pytest.raises(WireError, match="OTHER_ROBOT"):
        core.on_datagram(SIGNED, OPERATOR, 0)
    second = registration.on_answer(reply, unpack_stop(reply))
    [(reply, _)] = core.on_datagram(second, ROBOT, 0)
    assert core.on_datagram(SIGNED, OPERATOR, 0)
    assert registration.on_answer(reply, unpack_stop(reply)) is None


@pytest.mark.parametrize(("secret", "challenge", "reason"), [
    (SECRET, b"x" * 16, "OTHER_SESSION"), (SECRET, CHALLENGE, "OTHER_SESSION"),
    (b"another", challenge_of(CHALLENGE, *OPERATOR[1]), "WRONG_KEY"),
    (b"", challenge_of(CHALLENGE, *OPERATOR[1]), "WRONG_KEY"),
])  # fmt: skip
def test_with_keys_no_third_party_registers(secret, challenge, reason):
    core = ForwarderCore(SECRET, CHALLENGE)
    data = pack_stop(StopDatagram(Kind.REGISTER, "r1", 7, challenge), secret)
    with pytest.raises(WireError, match=reason):
        core.on_datagram(data, OPERATOR, 0)
    with pytest.raises(WireError, match="OTHER_ROBOT"):
        core.on_datagram(SIGNED, OPERATOR, 0)


def registered(core, registration, *origins):
    """Register as a robot does whose datagram arrives from each of `origins`. Returns its last datagram."""
    sent = [(registration.datagram(), origin) for origin in origins]
    for data, origin in sent:
        [(reply, back)] = core.on_datagram(data, origin, 0)
        assert back == origin
        if second := registration.on_answer(reply, unpack_stop(reply)):
            sent.append((second, origin))
        assert len(sent) <= 2 * len(origins), "an answer to an answer"
    return sent[-1][0]


@pytest.mark.parametrize("origin", [
    (3, ("10.0.0.1", 9)), (3, ("10.0.0.2", 50000)), (4, ("2001:db8::1", 50000, 0, 0)), OPERATOR,
])  # fmt: skip
def test_with_keys_a_recorded_registration_counts_only_from_its_own_address_and_port(origin):
    core = ForwarderCore(SECRET, CHALLENGE)
    recorded = registered(core, Registration("r1", SECRET, 5), ROBOT)
    assert unpack_stop(recorded).challenge != NO_CHALLENGE
    with pytest.raises(WireError, match="OTHER_SESSION"):
        core.on_datagram(recorded, origin, 4_000_000)
    assert core.on_datagram(SIGNED, OPERATOR, 4_000_000) == [(SIGNED, ROBOT)]


def test_with_keys_a_robot_registers_from_both_families_and_from_a_new_port_of_its_nat():
    core, registration = ForwarderCore(SECRET, CHALLENGE), Registration("r1", SECRET, 5)
    second, moved = (4, ("2001:db8::1", 50001, 0, 0)), (3, ("10.0.0.1", 50007))
    registered(core, registration, ROBOT, second)
    assert [place for _, place in core.on_datagram(SIGNED, OPERATOR, 0)] == [ROBOT, second]
    registered(core, registration, moved, second)
    assert [place for _, place in core.on_datagram(SIGNED, OPERATOR, 0)] == [moved, second]


def test_a_router_that_starts_again_gives_its_new_challenge():
    registration = Registration("r1", SECRET, 5)
    for challenge in (CHALLENGE, b"d" * 16):
        core = ForwarderCore(SECRET, challenge)
        sent = [registration.datagram() for _ in range(3)][-1]
        assert unpack_stop(sent).challenge == NO_CHALLENGE
        [(reply, _)] = core.on_datagram(sent, ROBOT, 0)
        core.on_datagram(registration.on_answer(reply, unpack_stop(reply)), ROBOT, 0)
        assert core.on_datagram(SIGNED, OPERATOR, 0)


def test_an_answer_to_another_registration_is_ignored():
    for secret, newest in ((b"", 7), (SECRET, 8)):  # with a secret it may have answered a challenge, too
        registration = Registration("r1", secret, 5)
        assert unpack_stop(registration.datagram()).counter == 7
        counters = (5, 7, newest, newest + 1)
        awaited = [registration.awaits(StopDatagram(Kind.ANSWER, "r1", counter)) for counter in counters]
        assert awaited == [False, True, True, False]
        assert not registration.awaits(StopDatagram(Kind.STOP, "r1", 7))
