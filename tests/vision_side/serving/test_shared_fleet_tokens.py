"""Tokens that end, at a fleet that shares robots, in virtual time and without a network."""

import pytest

from sightline.protocol.channels import STATUS
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.tokens import DriverToken, RobotToken, VisionToken
from sightline.vision_side.config import DetectorConfig, ShareConfig, VisionConfig
from sightline.vision_side.serving import fleet as fleet_module
from sightline.vision_side.serving.fleet import SharedFleet
from sightline.vision_side.serving.service import Service
from sightline.vision_side.serving.sharing import SharingPart

MS = 1_000


class Site:
    """A fleet and the robots whose tokens it sees."""

    def __init__(self, monkeypatch, count, pattern="r*"):
        self.now_us, self.connected, self.losses = 1_000_000, True, 0
        self._network, self.declared, self.watching = MemoryNetwork(seed=1), [], []
        monkeypatch.setattr(fleet_module, "monotonic_us", lambda: self.now_us)
        config = VisionConfig(robot=pattern, connect=("tcp/127.0.0.1:1",), detector=DetectorConfig(kind="hsv"),
                              share=ShareConfig(enabled=True, name="a"))
        self.fleet = SharedFleet(config, self, lambda _line: None)
        self.robots = [f"r{number}" for number in range(count)]
        for robot in self.robots:
            self.note(RobotToken(robot), True)
        self.turn(count)
        self.turn(ms=300)

    def on_new_robot(self, callback):
        pass

    def watch_tokens(self, callback):
        self.watching.append(callback)
        return lambda: self.watching.remove(callback)

    def note(self, token, is_present):
        for callback in self.watching.copy():
            callback(token, is_present)

    def declare_token(self, token):
        self.declared.append(token)
        return lambda: None

    def link(self, robot):
        return self._network.link(robot, role="vision")

    def hear(self, robot):
        """Let the message of a robot arrive."""
        self._network.link(robot).publish(STATUS, b"", b"")
        self._network.advance(self.now_us)

    def turn(self, times=1, ms=1):
        for _ in range(times):
            self.now_us += ms * MS
            self.fleet.turn()


def test_robots_whose_tokens_end_long_before_the_loss_of_the_own_link_is_known_keep_their_services(monkeypatch):
    site = Site(monkeypatch, 40)
    before = dict(site.fleet.services)
    assert set(before) == set(site.robots)
    for robot in site.robots:
        site.note(RobotToken(robot), False)
        site.turn(ms=5)
    site.connected, site.losses = False, 1
    site.turn(20, ms=100)
    assert site.fleet.services == before
    site.connected = True
    site.turn()
    for robot in site.robots:
        site.note(RobotToken(robot), True)
    site.turn(50, ms=100)
    assert site.fleet.services == before


@pytest.mark.parametrize(("away_ms", "stays"), [(1, True), (490, True), (510, False)])
def test_robot_whose_own_link_was_cut_for_a_moment_gets_a_new_session_of_the_same_service(monkeypatch, away_ms, stays):
    site = Site(monkeypatch, 1)
    before, sender = site.fleet.services["r0"], site.fleet.services["r0"].sender
    site.note(RobotToken("r0"), False)
    site.turn(away_ms)
    site.note(RobotToken("r0"), True)
    site.turn()
    assert (site.fleet.services["r0"] is before) is stays
    assert site.fleet.services["r0"].sender is not sender and not site.fleet.services["r0"].is_standby


@pytest.mark.parametrize(("away_ms", "stays"), [(600, True), (9_900, True), (10_100, False)])
def test_robot_with_a_requested_mission_keeps_it_for_ten_seconds(monkeypatch, away_ms, stays):
    monkeypatch.setattr(Service, "has_request", True)
    site = Site(monkeypatch, 1)
    before = site.fleet.services["r0"]
    site.note(RobotToken("r0"), False)
    site.turn(away_ms // 10, ms=10)
    site.note(RobotToken("r0"), True)
    site.turn()
    assert (site.fleet.services["r0"] is before) is stays


@pytest.mark.parametrize("away_ms", [100, 600, 60_000])
def test_robot_that_is_named_gets_a_new_session_of_the_same_service(monkeypatch, away_ms):
    site = Site(monkeypatch, 1, pattern="r0")
    before, sender = site.fleet.services["r0"], site.fleet.services["r0"].sender
    site.note(RobotToken("r0"), False)
    site.turn(away_ms // 20, ms=20)
    site.note(RobotToken("r0"), True)
    site.turn()
    assert site.fleet.services["r0"] is before and before.sender is not sender and not before.is_standby


def test_a_driver_that_gives_up_claims_with_a_new_token_and_receives_frames_for_a_second(monkeypatch):
    site = Site(monkeypatch, 1)
    service, robot = site.fleet.services["r0"], site.fleet.sharing.robots["r0"]
    first = service.sender
    assert not service.is_standby
    site.note(DriverToken("r0", "b", "0" * 32), True)
    robot.mine_us, robot.status_us, robot.active_us, robot.has_held = 0, site.now_us, site.now_us, False
    site.turn()
    assert robot.part is SharingPart.STANDBY and service.is_standby and not service._is_subscribed
    assert "r0" not in site.fleet._withdraw
    site.turn(125, ms=10)
    assert robot.part is SharingPart.CLAIM and service.is_standby and service._is_subscribed
    assert service.sender is not first and "r0" in site.fleet._withdraw
    site.turn(100, ms=10)
    assert robot.part is SharingPart.CLAIM and not service._is_subscribed
    site.note(DriverToken("r0", "b", "0" * 32), False)
    site.fleet._bell.clear()
    site.turn(30)
    assert not service.is_standby and site.fleet._bell.is_set(), "a frame may wait"


def ended(monkeypatch):
    """A site with another service, whose token and the one with which it drives r0 end now."""
    site = Site(monkeypatch, 2)
    tokens = (VisionToken("b", 1.0, "0000000b"), DriverToken("r0", "b", "0" * 32))
    for is_present in (True, False):
        site.turn()
        for token in tokens:
            site.note(token, is_present)
    return site


def counts(site):
    """Return whether the end of the other service counts by now, and that of its driver too."""
    services = set(site.fleet.sharing.services())
    assert ("b" in services) == bool(site.fleet.sharing.robots["r0"].drivers)
    return services == {"a"}


def test_service_that_ends_counts_with_the_next_message_of_a_robot(monkeypatch):
    site = ended(monkeypatch)
    site.turn(2)
    assert not counts(site)
    site.hear("r1")
    site.turn()
    assert counts(site)


def test_service_that_ends_counts_without_a_message_30_ms_after_the_last_token_that_ended(monkeypatch):
    site = ended(monkeypatch)
    site.turn(29)
    site.note(RobotToken("r1"), False)
    site.turn(29)
    assert not counts(site)
    site.turn()
    assert counts(site)


def test_service_that_ends_counts_after_100_ms_whatever_else_ends(monkeypatch):
    site = ended(monkeypatch)
    for number in range(99):
        site.note(DriverToken("r1", f"c{number}", "1" * 32), False)
        site.turn()
    assert not counts(site)
    site.turn()
    assert counts(site)


@pytest.mark.parametrize("each_ms", [1, 9, 20])
def test_robots_get_no_second_driver_while_the_tokens_beyond_a_link_that_ended_end_one_by_one(monkeypatch, each_ms):
    """The end of the link is known after that of the last token. The other service is there, and drives on."""
    site = Site(monkeypatch, 3)
    tokens = [VisionToken("b", 1.0, "0000000b"), *(DriverToken(robot, "b", "0" * 32) for robot in site.robots)]
    for token in tokens:
        site.note(token, True)
    site.turn(20, ms=100)
    site.hear("r0")
    parts = {name: robot.part for name, robot in site.fleet.sharing.robots.items()}
    assert SharingPart.STANDBY in parts.values()
    for token in tokens:
        site.turn()
        site.note(token, False)
        site.turn(each_ms)
    site.connected, site.losses = False, 1
    site.turn(each_ms)
    assert {name: robot.part for name, robot in site.fleet.sharing.robots.items()} == parts


def test_token_of_a_service_that_came_during_a_flood_counts_after_it(monkeypatch):
    site, real = Site(monkeypatch, 1), VisionToken("b", 1.0, "0000000b")
    fakes = [VisionToken(f"x{number}", 0.01, "00000001") for number in range(256)]
    for token in (*fakes, real):
        site.note(token, True)
    site.turn(2, ms=6_000)
    assert "b" not in site.fleet.sharing.services() and len(site.watching) == 1
    for token in fakes:
        site.note(token, False)
    site.turn(3, ms=100)
    first, second = site.watching
    for token in (real, fakes[0]):
        first(token, False)
        second(token, True)  # late
    second(VisionToken("c", 1.0, "0000000c"), True)
    site.turn(3, ms=100)
    assert set(site.fleet.sharing.services()) == {"a", "c"}
    second(VisionToken("c", 1.0, "0000000c"), False)
    site.turn(44, ms=100)
    assert set(site.fleet.sharing.services()) == {"a", "c"} and len(site.watching) == 2, "the first watch counts"
    site.turn(ms=100)
    assert site.watching == [first]
    first(real, True)
    site.turn(20, ms=600)
    assert set(site.fleet.sharing.services()) == {"a", "b", "c"} and len(site.watching) == 1


def test_ends_that_wait_are_bounded(monkeypatch):
    monkeypatch.setattr(fleet_module, "_MAX_TOKENS", 50)
    site = Site(monkeypatch, 2)
    for number in range(200):
        site.note(RobotToken(f"r{number + 100}"), False)
        site.turn()
    site.note(RobotToken("r1"), False)
    site.turn()
    assert len(site.fleet._ends_us) == 50 and set(site.fleet.services) == {"r0"}, "the end counts at once"


def test_robot_whose_token_comes_soon_after_its_reply_is_not_reported(monkeypatch):
    site, lines = Site(monkeypatch, 1), []
    site.find_robots = lambda: {"r0", "r7", "r8"}
    monkeypatch.setattr(site.fleet, "_report", lines.append)

    def wait(seconds):
        site.note(RobotToken("r7"), True)
        site.turn()
        return seconds == 60.0

    monkeypatch.setattr(site.fleet._ending, "wait", wait)
    site.fleet._report_older()
    assert [line for line in lines if "token" in line] == [
        "vision: r8: not shared (no token); update it or pass --robot r8"]
