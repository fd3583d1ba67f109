"""The driver's loop on a virtual clock: 50 ticks a second, however late each one wakes."""

import signal
from bisect import bisect_left
from itertools import accumulate, pairwise
from random import Random
from types import SimpleNamespace

import pytest

from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver import process
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.driver.persistence import StopLatch
from sightline.robot_side.driver.process import Driver
from sightline.robot_side.driver.supervision import EXIT_SIGNALS, IGNORED_SIGNALS
from sightline.robot_side.safety.limits import MIN_TICK_US, TICK_US


class VirtualLoop:
    """Clock, drive, network process and `select` of one loop. It wakes `late_us` after each deadline."""

    socket, failed_at_start, exit_code, restarts = None, False, 0, 0

    def __init__(self, late_us):
        self.now_us, self.late_us = 10_000_000, late_us
        self.asleep_us = 0
        self.ticks_us = []

    def select(self, _readable, _writable, _broken, timeout_s):
        self.now_us += round(timeout_s * 1e6) + self.late_us

    def set(self, left_rad_s, right_rad_s):
        self.ticks_us.append(self.now_us)

    def wheels(self):
        return None

    def packets(self):
        return iter(())

    def send(self, packet):
        pass

    send_aside = send

    def keep_alive(self, now_us, first_seq):
        pass

    def is_start_due(self, now_us):
        return False


@pytest.fixture
def run(tmp_path, monkeypatch):
    handlers = {number: signal.getsignal(number) for number in (*EXIT_SIGNALS, *IGNORED_SIGNALS)}
    made = []

    def run(loop, seconds):
        """Run the loop for so long and return the times of its ticks, from its start on."""
        monkeypatch.setattr(process, "monotonic_us", lambda: loop.now_us + loop.asleep_us)
        monkeypatch.setattr(process, "heartbeat_us", lambda: loop.now_us)
        monkeypatch.setattr(process, "select", SimpleNamespace(select=loop.select))
        monkeypatch.setattr(process, "request_real_time", lambda _priority: ())
        driver = Driver(RobotConfig(state_dir=tmp_path), loop, None)
        made.append(driver)
        driver.driver_end, loop.core = loop, driver._driver_core
        monkeypatch.setattr(driver, "_on_packet", lambda _packet: True)
        started_us, tick = loop.now_us, driver._tick

        def counted(now_us):
            tick(now_us)
            if loop.now_us - started_us >= seconds * 1e6:
                driver._on_signal(signal.SIGTERM, None)

        monkeypatch.setattr(driver, "_tick", counted)
        assert driver.loop() == 0
        return [tick_us - started_us for tick_us in loop.ticks_us]

    yield run
    for driver in made:
        driver.latch_writer.close()
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_ticks_that_wake_late_still_come_50_times_a_second(run):
    """Each deadline follows from the deadline before it, not from the time of waking."""
    ticks_us = run(VirtualLoop(late_us=3_000), seconds=2.0)
    assert ticks_us == [3_000 + 20_000 * number for number in range(len(ticks_us))]
    assert len(ticks_us) == 101


def test_deadlines_that_a_stall_has_passed_are_not_caught_up(run):
    loop = VirtualLoop(late_us=0)
    select = loop.select

    def stall_once(*arguments):
        select(*arguments)
        loop.now_us += 500_000 if len(loop.ticks_us) == 5 else 0

    loop.select = stall_once
    ticks_us = run(loop, seconds=1.0)
    gaps_us = [after - before for before, after in pairwise(ticks_us)]
    assert gaps_us[:4] == [20_000] * 4 and gaps_us[4] == 520_000
    assert sum(gap_us < 20_000 for gap_us in gaps_us[5:]) <= 1, "at most one tick follows at once"


def test_robot_that_slept_for_an_hour_is_not_late(run):
    loop = VirtualLoop(late_us=3_000)
    select = loop.select

    def sleep_once(*arguments):
        select(*arguments)
        loop.asleep_us = 3_600_000_000 if len(loop.ticks_us) >= 5 else 0

    loop.select = sleep_once
    assert len(run(loop, seconds=0.4)) == 21
    assert loop.core.tick_late_max_us == 3_000


@pytest.mark.parametrize(("is_stopped", "lines"), [
    (False, ["robot r1: DISARMED (shutting down)"]), (True, ["robot r1: STOPPED (shutting down)"]),
])
def test_end_of_a_robot_at_rest_is_one_line(run, tmp_path, caplog, is_stopped, lines):
    caplog.set_level("INFO", "sightline")
    if is_stopped:
        StopLatch(tmp_path, "r1").write(stopped=True)
    run(VirtualLoop(late_us=0), seconds=0.1)
    assert caplog.messages == lines


def test_end_of_a_robot_in_motion_is_one_line_too(run, monkeypatch, caplog):
    caplog.set_level("INFO", "sightline")
    loop = VirtualLoop(late_us=0)
    monkeypatch.setattr(DriverCore, "at_rest", property(lambda _core: len(loop.ticks_us) > 9))
    assert run(loop, seconds=0.1)[-1] == 180_000, "it ramps to zero"
    assert caplog.messages == ["robot r1: DISARMED (shutting down)"]


def test_robot_whose_network_process_failed_at_its_start_adds_no_line(run, caplog):
    caplog.set_level("INFO", "sightline")
    loop = VirtualLoop(late_us=0)
    loop.failed_at_start = True
    run(loop, seconds=0.1)
    assert caplog.messages == []


def commanded(loop, gaps_us):
    """Let commands arrive so long after each other, the first one after 500 us. Returns the times of those so far."""
    arrivals_us = iter(accumulate(gaps_us, initial=loop.now_us + 500))
    arrived_us = []
    loop.next_us = next(arrivals_us)

    def select(_readable, _writable, _broken, timeout_s):
        loop.now_us = min(loop.now_us + round(timeout_s * 1e6), max(loop.now_us, loop.next_us))

    def packets():
        while loop.next_us <= loop.now_us:
            arrived_us.append(loop.next_us)
            loop.next_us = next(arrivals_us, 1 << 60)
            yield b"a command"

    loop.select, loop.packets = select, packets
    return arrived_us


@pytest.mark.parametrize("seed", range(3))
def test_no_command_waits_for_a_tick_that_it_does_not_need(run, seed):
    random = Random(seed)
    loop = VirtualLoop(late_us=0)
    started_us = loop.now_us
    arrived_us = commanded(loop, [random.choice((200, 1_500, 9_000, 40_000)) for _ in range(1_700)])
    ticks_us = run(loop, seconds=25.0)
    waits_us = [next(tick for tick in ticks_us[bisect_left(ticks_us, at - started_us):]) - (at - started_us)
                for at in arrived_us]
    assert len(waits_us) == 1_701 and max(waits_us) <= MIN_TICK_US
    alone = [wait_us for wait_us, (before, at) in zip(waits_us[1:], pairwise(arrived_us), strict=True)
             if at - before >= 2 * MIN_TICK_US]
    assert len(alone) > 700 and max(alone) == 0, "a tick in time holds up no command"
    gaps_us = [after - before for before, after in pairwise(ticks_us)]
    assert max(gaps_us) == TICK_US, "with commands or without"
    after_short_us = [before for before, gap_us in pairwise(gaps_us) if gap_us < MIN_TICK_US]
    assert set(after_short_us) <= {TICK_US}, "commands come at most once in that time"


@pytest.mark.parametrize("gap_us", [33_333, 25_000, 66_667])
def test_commands_at_the_rate_of_images_meet_no_tick(run, gap_us):
    """The tick before is as long ago as the gap leaves, and what a tick does beside has long ended."""
    loop = VirtualLoop(late_us=0)
    started_us = loop.now_us
    arrived_us = commanded(loop, [gap_us] * 60)
    ticks_us = run(loop, seconds=1.4)
    for at_us in (one - started_us for one in arrived_us[1:]):
        place = bisect_left(ticks_us, at_us)
        assert ticks_us[place] == at_us and at_us - ticks_us[place - 1] == gap_us % TICK_US
