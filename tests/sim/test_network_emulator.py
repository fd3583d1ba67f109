"""The bad network: each of its harms in virtual time, and real packets between two namespaces."""

import itertools
import json
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.evaluation.faults.fixture import BenchWire
from sightline.protocol.errors import ConfigError
from sightline.sim.network_emulator import (
    IP_HEADER_BYTES,
    MAX_WAITING,
    EmulatedLeg,
    EmulatedLink,
    LinkShape,
    LinkShapes,
    Medium,
)
from sightline.sim.tun_emulator import ADDRESS_A, _read_shapes, why_impossible

PACKET = bytes(range(100))
LONG_US = 10**9
shapes = st.builds(
    LinkShape,
    delay_ms=st.floats(0, 100),
    jitter_ms=st.floats(0, 50),
    loss=st.floats(0, 1),
    burst_start=st.floats(0, 1),
    burst_end=st.floats(0.01, 1),
    rate_bit_s=st.sampled_from([0, 1e4, 1e6]),
    duplicate=st.floats(0, 1),
    reorder=st.floats(0, 1),
    corrupt=st.floats(0, 1),
    queue_packets=st.integers(1, MAX_WAITING),
    cut=st.booleans(),
)


def leg(seed="1", **shape):
    made = EmulatedLeg(seed)
    made.shape = LinkShape(**shape)
    return made


def numbered(count):
    return [index.to_bytes(4, "big") * 25 for index in range(count)]


def carry(wire, packets, every_us=1000, until_us=LONG_US):
    out = []
    for index, packet in enumerate(packets):
        wire.put(packet, index * every_us)
        out += wire.take_due(index * every_us)
    return out + list(wire.take_due(until_us))


@given(shapes, st.integers(0, 60), st.text(max_size=4))
def test_every_packet_is_accounted_for(shape, count, seed):
    wire = EmulatedLeg(seed)
    wire.shape = shape
    out = carry(wire, [PACKET] * count)
    counts = wire.counts
    assert counts.taken == count and counts.delivered == len(out) and wire.next_us is None
    assert counts.delivered_bytes == sum(map(len, out))
    assert counts.taken + counts.duplicated == counts.delivered + counts.lost + counts.cut + counts.overflow


@given(shapes, st.text(max_size=4))
def test_the_same_seed_does_the_same(shape, seed):
    first, second = EmulatedLeg(seed), EmulatedLeg(seed)
    first.shape = second.shape = shape
    assert carry(first, numbered(30)) == carry(second, numbered(30))


@given(st.floats(0, 200), st.floats(0, 100))
def test_delay_and_jitter_keep_the_order_and_the_least_time(delay_ms, jitter_ms):
    wire = leg(delay_ms=delay_ms, jitter_ms=jitter_ms)
    packets = numbered(20)
    least_us = max(0.0, delay_ms - jitter_ms) * 1000
    for packet in packets:
        wire.put(packet, 0)
    assert wire.next_us >= least_us
    assert list(wire.take_due(LONG_US)) == packets


def test_the_default_is_a_perfect_wire():
    packets = numbered(50)
    wire = leg()
    assert carry(wire, packets, until_us=49_000) == packets
    counts = wire.counts
    assert (counts.delayed, counts.lost, counts.duplicated, counts.reordered, counts.corrupted) == (0, 0, 0, 0, 0)


@pytest.mark.parametrize("loss", [0.05, 0.2, 0.5])
def test_loss_is_as_requested(loss):
    assert 1 - len(carry(leg(loss=loss), [PACKET] * 4000)) / 4000 == pytest.approx(loss, abs=0.03)


def test_bursts_lose_in_a_row():
    out = carry(leg(burst_start=0.02, burst_end=0.2), numbered(4000))
    seqs = [int.from_bytes(packet[:4], "big") for packet in out]
    gaps = [after - before - 1 for before, after in itertools.pairwise(seqs) if after - before > 1]
    assert sum(gaps) / len(gaps) == pytest.approx(5, abs=1)


def test_a_rate_spaces_packets_by_their_size():
    wire = leg(rate_bit_s=1e6)
    for packet in numbered(10):
        wire.put(packet, 0)
    times_us = []
    while (due_us := wire.next_us) is not None:
        times_us.append(due_us)
        assert len(list(wire.take_due(due_us))) == 1
    assert times_us == pytest.approx([800 * index for index in range(1, 11)])


def test_half_duplex_shares_the_time_and_two_directions_do_not():
    for half_duplex, last_us in ((True, 1600), (False, 800)):
        wire = EmulatedLink()
        shape = LinkShape(rate_bit_s=1e6)
        wire.shape(LinkShapes(ab=shape, ba=shape, half_duplex=half_duplex))
        wire.ab.put(PACKET, 0)
        wire.ba.put(PACKET, 0)
        assert wire.ba.next_us == pytest.approx(last_us)


def test_directions_are_shaped_apart():
    wire = EmulatedLink()
    wire.shape(LinkShapes(ab=LinkShape(cut=True)))
    wire.ab.put(PACKET, 0)
    wire.ba.put(PACKET, 0)
    assert list(wire.ab.take_due(LONG_US)) == [] and list(wire.ba.take_due(0)) == [PACKET]
    assert wire.counts()["ab"]["cut"] == 1 and wire.counts()["ba"]["cut"] == 0


def test_half_duplex_can_be_left_again():
    wire = EmulatedLink()
    wire.shape(LinkShapes(half_duplex=True))
    assert wire.ab.medium is wire.ba.medium
    wire.shape(LinkShapes())
    assert wire.ab.medium is not wire.ba.medium and wire.ba.medium == Medium()


def test_reordered_packets_overtake_what_waits():
    wire = leg(delay_ms=50, reorder=0.3)
    out = carry(wire, numbered(100))
    assert out != sorted(out) and sorted(out) == numbered(100) and wire.counts.reordered > 10


def test_a_duplicate_is_the_same_packet_again():
    out = carry(leg(duplicate=1.0), numbered(10))
    assert out == [packet for packet in numbered(10) for _ in range(2)]


@given(st.binary(min_size=IP_HEADER_BYTES + 1, max_size=80), st.text(max_size=4))
def test_corruption_flips_one_bit_behind_the_ip_header(packet, seed):
    (out,) = carry(leg(seed, corrupt=1.0), [packet])
    flipped = [a ^ b for a, b in zip(packet, out, strict=True)]
    assert sum(bits.bit_count() for bits in flipped) == 1 and not any(flipped[:IP_HEADER_BYTES])


def test_the_queue_is_bounded():
    wire = leg(delay_ms=100, queue_packets=5)
    for packet in numbered(9):
        wire.put(packet, 0)
    assert wire.counts.overflow == 4 and list(wire.take_due(LONG_US)) == numbered(5)


def test_a_cut_loses_what_is_under_way():
    wire = leg(delay_ms=100)
    wire.put(PACKET, 0)
    wire.shape = LinkShape(cut=True)
    assert list(wire.take_due(LONG_US)) == [] and wire.counts.cut == 1


@pytest.mark.parametrize("line", ["", "{", '{"ab": {"loss": 2}}', '{"ac": {}}', '{"ab": {"delay_ms": NaN}}'])
def test_invalid_shape_is_rejected_in_one_line(line):
    with pytest.raises(ConfigError) as caught:
        _read_shapes(line)
    assert "\n" not in str(caught.value)


# --- real packets ------------------------------------------------------------------------------------------------

needs_wire = pytest.mark.skipif(
    bool(why_impossible()), reason=f"{why_impossible()}; run the tests as root with /dev/net/tun"
)
_PROBE = """
import json, socket, sys, time
s, started = socket.socket(), time.monotonic()
s.settimeout(float(sys.argv[2]))
try: s.connect((sys.argv[1], 9)); outcome = "connected"
except ConnectionRefusedError: outcome = "closed"
except OSError: outcome = "silence"
print(json.dumps([outcome, time.monotonic() - started]))
"""


def probe(wire, timeout_s=5.0):
    """Connect to a closed port over the wire: the rejection is one packet each way."""
    command = ["ip", "netns", "exec", wire.far_side, sys.executable, "-c", _PROBE, ADDRESS_A, str(timeout_s)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def quickest_s(wire):
    """Return the least of a few times: on a busy machine a probe may wait for a processor."""
    probes = [probe(wire) for _ in range(3)]
    assert {outcome for outcome, _ in probes} == {"closed"}
    return min(seconds for _, seconds in probes)


@needs_wire
def test_real_packets_pass_are_late_and_are_cut_in_one_direction(tmp_path):
    with BenchWire(tmp_path / "wire.log") as wire:
        assert quickest_s(wire) < 0.05
        wire.shape(LinkShapes(ab=LinkShape(delay_ms=150), ba=LinkShape(delay_ms=100)))
        assert 0.25 <= quickest_s(wire) < 0.4
        before = wire.shape(LinkShapes(ab=LinkShape(cut=True)))
        assert probe(wire, 0.3)[0] == "silence"
        assert wire.shape(LinkShapes()) > before
        assert probe(wire)[0] == "closed"
        names = wire.robot_side, wire.far_side
    left = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout
    assert not any(name in left for name in names)
