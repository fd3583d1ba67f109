"""The stream on links that lose whole messages, in virtual time, and with peers and clocks that are wrong."""


import pytest

from sightline.protocol.channels import TWIST
from sightline.protocol.codec import encode
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.network.stream import Stream, StreamConfig
from sightline.robot_side.safety.limits import TICK_US, SafetyConfig
from tests.robot_side.network.fixture import VISION, Camera, Leg, run

pytestmark = pytest.mark.computes

SEEDS = [1, 2, 3]


def course(gone, *, in_a_row=1.0, delay_us=25_000, rate_bit_s=0.0, steps=(), seed=1, seconds=20.0, copies=1, **camera):
    """A link of +50 ms that loses the share `gone` of the messages in each direction."""
    out = Leg(delay_us, rate_bit_s, gone=gone, gone_in_a_row=in_a_row, steps=steps, seed=seed)
    back = Leg(delay_us, gone=gone, gone_in_a_row=in_a_row, seed=seed + 100)
    return run(out, back, camera=Camera(seed=seed, **camera), seconds=seconds, copies=copies)


def stands_ms(seen):
    """Return how long the robot had no command that was younger than 300 ms, each time, from the third second on."""
    return [gap_ms for gap_ms in seen.gaps_ms() if gap_ms > 300]


def share_sent(gone, **link):
    """Return the share of the images of the camera that were sent, after the first 5 s."""
    return (course(gone, **link).captures - course(gone, seconds=5.0, **link).captures) / (15 * 30)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("gone", [0.05, 0.1, 0.2, 0.3])
def test_loss_costs_neither_rate_nor_quality_nor_age(gone, seed):
    assert share_sent(gone, seed=seed, copies=2) >= 0.99
    seen = course(gone, seed=seed, copies=2)
    assert set(seen.windows[5_000:]) == {3}
    assert seen.stream.encoding_target == (100, 100)
    assert seen.p(99) <= 54, "no frame waits behind another"


@pytest.mark.parametrize("seed", SEEDS)
def test_bursts_of_loss_cost_neither_rate_nor_quality(seed):
    assert share_sent(0.1, in_a_row=2.0, seed=seed) >= 0.99
    assert course(0.1, in_a_row=2.0, seed=seed).stream.encoding_target == (100, 100)


BOUNDS = [(0.1, 0.0, 0), (0.2, 0.2, 600), (0.3, 1.0, 2_000)]


@pytest.mark.slow
@pytest.mark.parametrize(("gone", "a_minute", "longest_ms"), BOUNDS)
def test_twenty_minutes_of_loss_with_six_seeds_stop_the_robot_seldom(gone, a_minute, longest_ms):
    stands = [one for seed in range(6) for one in stands_ms(course(gone, seed=seed, seconds=1200.0, copies=2))]
    assert len(stands) <= a_minute * 6 * 20
    assert max(stands, default=0) <= longest_ms


@pytest.mark.parametrize("ends_us", [1_000_000, 6_000_000])
def test_stream_that_ends_for_good_is_a_stand_until_the_end(monkeypatch, ends_us):
    may_capture = Stream.may_capture
    monkeypatch.setattr(Stream, "may_capture", lambda stream, now_us, listening: (
        now_us < ends_us and may_capture(stream, now_us, listening=listening)))
    stands = stands_ms(course(0.1, seconds=10.0, copies=2))
    assert len(stands) == 1 and stands[0] >= 3_800


@pytest.mark.parametrize("gone", [0.0, 0.1, 0.2])
@pytest.mark.parametrize("seed", SEEDS)
def test_full_link_is_a_queue_with_and_without_loss(gone, seed):
    seen = course(gone, delay_us=5_000, rate_bit_s=1e6, seed=seed)
    assert seen.p(95, 5) <= 160 and seen.fps(5, 20) >= 8
    assert seen.bytes(5, 20) <= 13_000, "images were made to fit"


@pytest.mark.parametrize("gone", [0.0, 0.1])
@pytest.mark.parametrize("seed", SEEDS)
def test_step_of_the_rate_is_a_queue_with_and_without_loss(gone, seed):
    seen = course(gone, delay_us=5_000, steps=((0, 1e7), (10_000_000, 1e6)), seed=seed)
    assert seen.p(95, 5, 10) <= 130
    assert seen.p(95, 14, 20) <= 250, "young again within four seconds"
    assert seen.bytes(14, 20) <= 13_000


# --- bad input ---------------------------------------------------------------------------------------------------


def answered(compute_us=0, delay_us=60_000, jump_us=0, twice=False, reverse=False, seconds=5.0):
    """Return a stream after `seconds` and its widest window. The arguments make peer, link or clock wrong."""
    stream, flying, widest = Stream(StreamConfig()), [], 0
    seq = shift_us = 0
    for at_us in range(0, round(seconds * 1e6), 1_000):
        shift_us = jump_us if at_us >= seconds * 5e5 else 0
        now_us = at_us + shift_us
        due = [one for one in flying if one[0] <= at_us]
        flying = [one for one in flying if one[0] > at_us]
        for _, answered_seq in reversed(due) if reverse else due:
            for _ in range(1 + twice):
                stream.on_answer(VISION, answered_seq, compute_us, now_us)
        if stream.may_capture(now_us, listening=True):
            stream.on_sent(seq, now_us, now_us, 20_000)
            arrives_us = at_us + delay_us
            flying.append((-(-arrives_us // 100_000) * 100_000 if reverse else arrives_us, seq))
            seq += 1
        widest = max(widest, stream.window)
    return stream, widest


@pytest.mark.parametrize("wrong", [
    {"compute_us": -5_000_000}, {"compute_us": -1}, {"compute_us": 10**9}, {"jump_us": 5_000_000}, {"twice": True},
], ids=str)  # fmt: skip
def test_wrong_times_and_repeated_answers_do_not_widen_the_window(wrong):
    _, usual = answered()
    stream, widest = answered(**wrong)
    assert usual == 3 and widest <= usual
    assert 1 <= stream.window <= usual


def test_answers_out_of_order_do_not_widen_the_window():
    """They arrive in groups, the newest first: a link that is up to 100 ms longer."""
    _, widest = answered(reverse=True)
    assert widest <= 5


def test_everything_that_arrives_at_once_after_5_s_neither_widens_the_window_nor_returns_credit():
    stream, widest = answered(seconds=2.0)
    now_us, sent = 2_000_000, []
    for seq in range(10_000, 10_100):
        while not stream.may_capture(now_us, listening=True):
            now_us += 1_000
        if now_us > 7_000_000:
            break
        stream.on_sent(seq, now_us, now_us, 20_000)
        sent.append(seq)
    assert 10 <= len(sent) <= 20, "one at a time, twice a second"
    for seq in sent:
        stream.on_answer(VISION, seq, 3_000, 7_000_000)
        assert stream.window <= widest
    assert not stream.on_answer(VISION, sent[-1], 3_000, 7_000_000)


class Driven:
    """The driver process of an armed robot, and commands that cite its frames."""

    def __init__(self):
        config = RobotConfig(safety=SafetyConfig(auto_arm=True), range_sensor=PluginChoice(kind="none"))
        self.core, self.now_us, self.seq = DriverCore(config, "0000aaaa"), 0, 0
        for _ in range(100):
            self.tick(self.frame())
        assert max(self.core.tick(self.now_us, None, None)) > 1

    def frame(self):
        """Issue a frame now."""
        header = FrameHeader(session="0000aaaa", seq=self.now_us // TICK_US, t_us=self.now_us)
        self.core.on_issued(header.seq, header.t_us, 0)
        return header

    def command(self, frame):
        self.seq += 1
        header = AnswerHeader(source="vision", session="0000bbbb", seq=self.seq, echo=Echo.of(frame))
        self.core.on_twist(Message(TWIST, "vision", encode(header), b"0.4000|0.0000"), self.now_us)

    def tick(self, *frames):
        """Receive a command for each of `frames`, and return the wheel speeds, rad/s."""
        for frame in frames:
            self.command(frame)
        speeds = self.core.tick(self.now_us, None, None)
        self.now_us += TICK_US
        return speeds


def test_commands_that_arrive_at_once_after_5_s_move_nothing():
    robot = Driven()
    late = []
    for _ in range(5_000_000 // TICK_US):
        late.append(robot.frame())
        robot.tick()
    assert robot.tick(*[one for one in late if robot.now_us - one.t_us > 400_000]) == (0.0, 0.0)
    assert robot.core.gate.counters["STALE"] > 200
    assert all(robot.tick() == (0.0, 0.0) for _ in range(50))


def test_command_that_is_sent_again_and_again_ages_with_its_frame():
    """Each copy has a new number, and is accepted while its frame is young. It never makes the frame younger."""
    robot = Driven()
    frame = robot.frame()
    speeds = [robot.tick(frame, frame) for _ in range(40)]
    stopped = (400_000 + 320_000) // TICK_US  # the age of the frame, and the ramp
    assert max(speeds[5]) > 1 and set(speeds[stopped:]) == {(0.0, 0.0)}
