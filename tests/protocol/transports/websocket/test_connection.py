"""Who is given up, by time and by what is known of the way out: tables over `websocket_life`, to the microsecond."""

import pytest

from sightline.protocol.transports.websocket.connection import (
    PING_EVERY_US,
    SILENCE_US,
    STALLED_LIMIT_US,
    Keepalive,
    SendPath,
)

CLEAR = SendPath(full=False, taken_bytes=7, lost=False)
FULL = SendPath(full=True, taken_bytes=7, lost=False)
TICK_US = 250_000


def gives_up_at(way, heard_at=(), until_us=60_000_000) -> int | None:
    """When a connection ends that was heard at 0 and then at `heard_at`; `way` gives the way out at a time."""
    life, heard = Keepalive(0), sorted(heard_at)
    for now_us in range(0, until_us, TICK_US):
        while heard and heard[0] <= now_us:
            life.hear(heard.pop(0))
        if life.is_over(now_us, lambda: way(now_us)):  # noqa: B023
            return now_us
    return None


def test_silence_with_a_clear_way_out_is_two_seconds_to_the_microsecond():
    life = Keepalive(5)
    assert not life.is_over(5 + SILENCE_US - 1, lambda: CLEAR)
    assert life.is_over(5 + SILENCE_US, lambda: CLEAR)
    life.hear(6)
    assert not life.is_over(5 + SILENCE_US, lambda: CLEAR)
    assert life.is_over(6 + SILENCE_US, lambda: CLEAR)


def test_who_is_heard_is_not_looked_at():
    life = Keepalive(0)
    for now_us in range(0, 20_000_000, 100_000):
        life.hear(now_us)
        assert not life.is_over(now_us + 499_999, pytest.fail)


def test_a_ping_is_due_after_a_second_of_silence_and_each_second_of_it():
    life = Keepalive(0)
    life.hear(300_000)
    due = [now_us for now_us in range(0, 4_000_000, 100_000) if life.is_ping_due(now_us)]
    assert due == [1_300_000, 2_300_000, 3_300_000]
    assert PING_EVERY_US * 2 <= SILENCE_US


def test_a_slow_reader_stays_while_it_takes_something():
    for step_us in (1_000_000, 5_000_000, STALLED_LIMIT_US - TICK_US):
        assert gives_up_at(lambda now_us, step=step_us: SendPath(True, now_us // step, False), until_us=10**8) is None


def test_who_takes_nothing_for_long_is_given_up_at_last():
    assert gives_up_at(lambda _now: FULL) == STALLED_LIMIT_US + 500_000  # what was taken is first looked at then


def test_a_word_from_a_slow_reader_starts_its_time_again():
    assert gives_up_at(lambda _now: FULL, heard_at=[25_000_000]) == 25_000_000 + STALLED_LIMIT_US


def test_once_the_way_out_is_clear_a_slow_reader_has_two_seconds_to_answer():
    assert gives_up_at(lambda now_us: FULL if now_us < 10_000_000 else CLEAR) == 9_750_000 + SILENCE_US


def test_a_way_out_that_is_full_only_now_and_then_is_a_slow_reader_s():
    assert gives_up_at(lambda now_us: SendPath(now_us % 1_500_000 == 0, now_us, False)) is None


@pytest.mark.parametrize("full", [False, True])
def test_a_machine_that_acknowledges_nothing_is_given_up_after_two_seconds(full):
    assert gives_up_at(lambda now_us: SendPath(full, 7, now_us >= 1_000_000)) == SILENCE_US
    assert gives_up_at(lambda now_us: SendPath(True, now_us, now_us >= 9_000_000)) == 9_000_000
