"""Messages out of bytes: the short way gives what the library gives, however the bytes arrive, and nothing more."""

import random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode
from websockets.protocol import CLIENT, SERVER, Protocol

from sightline.protocol.transports.websocket.connection import MAX_FRAGMENTS, MessageReader, unmasked_head

BOUND = 70_000
SIZES = (0, 1, 125, 126, 127, 65_535, 65_536, BOUND - 1, BOUND, BOUND + 1)


def served(opcode: int, data: bytes, fin: bool = True) -> bytes:
    """A frame as a server sends it."""
    return Frame(Opcode(opcode), data, fin).serialize(mask=False)


def read(pieces, bound: int = BOUND) -> tuple[list, int | None]:
    """What a client makes of `pieces`, and with which code it hangs up."""
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


@settings(deadline=None)
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
    # Of two faults that arrive together either may be the one that is told.
    assert len({code is None for _, code in results}) == 1


@given(st.binary(max_size=40), st.integers(0, 40))
def test_any_bytes_are_read_alike_in_one_piece_and_in_two(text, at):
    assert read([text], 30) == read([text[:at], text[at:]], 30)


def test_a_masked_frame_from_a_server_and_an_unmasked_one_from_a_client_are_refused():
    masked = Frame(Opcode.BINARY, b"data").serialize(mask=True)
    assert read([masked]) == ([], 1002)
    protocol = Protocol(SERVER, max_size=100)
    messages = MessageReader(protocol)
    messages.feed(served(2, b"data"))
    assert (list(messages.ready), protocol.close_sent.code) == ([], 1002)


def test_after_a_hang_up_nothing_more_is_read():
    assert read([served(8, b"\x03\xe8"), served(2, b"late")]) == ([], 1000)
    assert read([served(2, bytes(BOUND + 1)), served(2, b"late")]) == ([], 1009)


def test_fragments_are_few():
    pieces = [served(2, b"", False), *([served(0, b"", False)] * (MAX_FRAGMENTS - 1))]
    assert read([*pieces, served(0, b"", True)])[1] == 1009
    assert read([*pieces[:-1], served(0, b"", True)]) == ([b""], None)
