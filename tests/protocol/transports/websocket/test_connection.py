"""Connections given up, by time and by send path: tables over `connection.py`, exact to the microsecond."""

import random
import select
import socket
import ssl
import time
from contextlib import suppress

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode
from websockets.protocol import CLIENT, SERVER, Protocol

from sightline.protocol.transports.websocket.connection import (
    MAX_FRAGMENTS,
    PING_EVERY_US,
    SILENCE_US,
    STALLED_LIMIT_US,
    Connection,
    Keepalive,
    MessageReader,
    SendPath,
    unmasked_head,
)
from tests.fixtures.ports import free_port

CLEAR = SendPath(full=False, taken_bytes=7, lost=False)
FULL = SendPath(full=True, taken_bytes=7, lost=False)
TICK_US = 250_000


def gives_up_at(way, heard_at=(), until_us=60_000_000) -> int | None:
    """Return the end of a connection with data at 0 and at `heard_at`; `way` returns the send path at a time."""
    life, heard = Keepalive(0), sorted(heard_at)
    for now_us in range(0, until_us, TICK_US):
        while heard and heard[0] <= now_us:
            life.note_data(heard.pop(0))
        if life.is_over(now_us, lambda: way(now_us)):  # noqa: B023
            return now_us
    return None


def test_silence_with_a_free_send_path_ends_after_exactly_two_seconds():
    life = Keepalive(5)
    assert not life.is_over(5 + SILENCE_US - 1, lambda: CLEAR)
    assert life.is_over(5 + SILENCE_US, lambda: CLEAR)
    life.note_data(6)
    assert not life.is_over(5 + SILENCE_US, lambda: CLEAR)
    assert life.is_over(6 + SILENCE_US, lambda: CLEAR)


def test_send_path_of_an_active_peer_is_not_read():
    life = Keepalive(0)
    for now_us in range(0, 20_000_000, 100_000):
        life.note_data(now_us)
        assert not life.is_over(now_us + 499_999, pytest.fail)


def test_a_ping_is_due_after_a_second_of_silence_and_each_second_of_it():
    life = Keepalive(0)
    life.note_data(300_000)
    due = [now_us for now_us in range(0, 4_000_000, 100_000) if life.is_ping_due(now_us)]
    assert due == [1_300_000, 2_300_000, 3_300_000]
    assert PING_EVERY_US * 2 <= SILENCE_US


def test_a_slow_reader_stays_while_it_takes_something():
    for step_us in (1_000_000, 5_000_000, STALLED_LIMIT_US - TICK_US):
        assert gives_up_at(lambda now_us, step=step_us: SendPath(True, now_us // step, False), until_us=10**8) is None


def test_peer_that_reads_nothing_for_long_is_closed():
    assert gives_up_at(lambda _now: FULL) == STALLED_LIMIT_US + 500_000  # what was taken is first looked at then


def test_message_of_a_slow_reader_restarts_its_time_limit():
    assert gives_up_at(lambda _now: FULL, heard_at=[25_000_000]) == 25_000_000 + STALLED_LIMIT_US


def test_slow_reader_with_a_free_send_path_has_two_seconds_to_answer():
    assert gives_up_at(lambda now_us: FULL if now_us < 10_000_000 else CLEAR) == 9_750_000 + SILENCE_US


def test_send_path_that_is_full_at_times_counts_as_a_slow_reader():
    assert gives_up_at(lambda now_us: SendPath(now_us % 1_500_000 == 0, now_us, False)) is None


@pytest.mark.parametrize("full", [False, True])
def test_machine_without_acknowledgments_is_closed_after_two_seconds(full):
    assert gives_up_at(lambda now_us: SendPath(full, 7, now_us >= 1_000_000)) == SILENCE_US
    assert gives_up_at(lambda now_us: SendPath(True, now_us, now_us >= 9_000_000)) == 9_000_000


class Records(socket.socket):
    """A socket with decrypted data, which `poll` does not see."""

    def pending(self):
        return 5


def test_decrypted_data_that_may_not_be_read_yet_does_not_keep_the_thread_busy(monkeypatch):
    """A peer that sends much and reads nothing: what is for it waits, and so does what it sent."""
    monkeypatch.setattr(ssl, "SSLSocket", Records)
    with socket.create_server(("127.0.0.1", free_port())) as server:
        far = socket.create_connection(server.getsockname())
        near = Records(fileno=server.accept()[0].detach())
    connection = Connection(near, Protocol(SERVER))
    while select.select([], [near], [], 0.05)[1]:
        with suppress(BlockingIOError):
            near.send(bytes(1 << 20))
    connection._unsent.extend([b"waits"] * 12)
    began_s = time.monotonic()
    connection.wait(0.1)
    assert time.monotonic() - began_s >= 0.1
    connection.shut()
    far.close()


# Messages out of bytes: the short way gives what the library gives, however the bytes arrive, and nothing more.


BOUND = 70_000
SIZES = (0, 1, 125, 126, 127, 65_535, 65_536, BOUND - 1, BOUND, BOUND + 1)


def served(opcode: int, data: bytes, fin: bool = True) -> bytes:
    """A frame as a server sends it."""
    return Frame(Opcode(opcode), data, fin).serialize(mask=False)


def read(pieces, bound: int = BOUND) -> tuple[list, int | None]:
    """Return the messages that a client reads from `pieces`, and the code with which it hangs up."""
    protocol = Protocol(CLIENT, max_size=bound)
    messages = MessageReader(protocol)
    for piece in pieces:
        messages.feed(piece)
    return list(messages.ready), protocol.close_sent.code if protocol.close_sent else None


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("opcode", [1, 2])
def test_a_message_is_the_same_in_one_piece_and_in_two_and_within_its_bound(opcode, size):
    frame, data = served(opcode, bytes(size)), bytes(size).decode() if opcode == 1 else bytes(size)
    expected = ([data], None) if size <= BOUND else ([], 1009)
    assert read([frame]) == read([frame[:3], frame[3:]]) == read([frame[:-1], frame[-1:]]) == expected


@pytest.mark.parametrize("size", [0, 1, 125, 126, 65_535, 65_536, 1_000_000])
@pytest.mark.parametrize("opcode", [1, 2])
def test_the_head_is_that_of_the_library(opcode, size):
    assert unmasked_head(size, opcode == 1) + bytes(size) == served(opcode, bytes(size))


FRAMES = st.tuples(st.sampled_from([0, 1, 2, 8, 9, 10]), st.binary(max_size=120), st.booleans())


@given(st.lists(FRAMES, max_size=6), st.randoms(use_true_random=False))
@example([(1, b"\xff", True)], random.Random(1))
@example([(2, b"a", False), (1, b"b", True)], random.Random(1))
def test_any_frames_are_read_alike_however_they_are_cut(frames, dice):
    whole = [Frame(Opcode(op), data, fin or op > 2).serialize(mask=False) for op, data, fin in frames]
    text = b"".join(whole)
    cuts = sorted(dice.randrange(len(text) + 1) for _ in range(4))
    cut = [text[a:b] for a, b in zip([0, *cuts], [*cuts, len(text)], strict=True)]
    bytewise = [text[at : at + 1] for at in range(len(text))]
    results = [read(pieces, 200) for pieces in (whole, cut, bytewise, [text])]
    assert results[0][0] == results[1][0] == results[2][0] == results[3][0]
    # Either of two faults that arrive together may be the reported one.
    assert len({code is None for _, code in results}) == 1


@given(st.binary(max_size=40), st.integers(0, 40))
def test_any_bytes_are_read_alike_in_one_piece_and_in_two(text, at):
    assert read([text], 30) == read([text[:at], text[at:]], 30)


def test_a_masked_frame_from_a_server_and_an_unmasked_one_from_a_client_are_rejected():
    masked = Frame(Opcode.BINARY, b"data").serialize(mask=True)
    assert read([masked]) == ([], 1002)
    protocol = Protocol(SERVER, max_size=100)
    messages = MessageReader(protocol)
    messages.feed(served(2, b"data"))
    assert (list(messages.ready), protocol.close_sent.code) == ([], 1002)


def test_nothing_is_read_after_a_close():
    assert read([served(8, b"\x03\xe8"), served(2, b"late")]) == ([], 1000)
    assert read([served(2, bytes(BOUND + 1)), served(2, b"late")]) == ([], 1009)


def test_number_of_fragments_is_bounded():
    pieces = [served(2, b"", False), *([served(0, b"", False)] * (MAX_FRAGMENTS - 1))]
    assert read([*pieces, served(0, b"", True)])[1] == 1009
    assert read([*pieces[:-1], served(0, b"", True)]) == ([b""], None)
