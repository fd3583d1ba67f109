"""Liveliness tokens over real sessions: presence, end with the session, and tokens of other peers."""

import time
from contextlib import ExitStack

import pytest

from sightline.operator_side.setup import keys
from sightline.protocol.transports.tokens import DetectorToken, DriverToken, RobotToken, VisionToken
from sightline.protocol.transports.zenoh.link import declare_token, open_fleet, open_zenoh
from sightline.protocol.transports.zenoh.session import open_session
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint

pytestmark = pytest.mark.waits

TOKENS = [f"{number:032x}" for number in range(5)]


class Watcher:
    """Records what `watch_drivers` or `watch_tokens` reports."""

    def __init__(self):
        self.seen = []

    def __call__(self, token, is_present):
        self.seen.append((token, is_present))

    @property
    def present(self):
        return {token for token, _ in self.seen if dict(self.seen)[token]}


@pytest.fixture
def site():
    """Two routers, a robot at the first one, and a function that opens a fleet link at either of them."""
    with ExitStack() as ending:
        endpoints = free_endpoint(), free_endpoint()
        for listen, connect in ((endpoints[:1], ()), (endpoints[1:], endpoints[:1])):
            ending.callback(open_session(listen, connect, 5.0).close)
        robot = ending.enter_context(open_zenoh("r1", connect=[endpoints[0]], role="robot"))

        yield robot, lambda number=0: ending.enter_context(
            open_fleet("*", connect=[endpoints[number]], role="vision", by_status=False)
        )


def test_robots_and_services_see_each_other_also_who_comes_later(site):
    robot, fleet = site
    first, second, watchers = fleet(0), fleet(1), (Watcher(), Watcher())
    own = [VisionToken("a", 1.0, "0000000a"), VisionToken("b", 2.0, "0000000b")]
    declared = [first.declare_token(own[0])]
    for one, watcher in zip((first, second), watchers, strict=True):
        one.watch_tokens(watcher)
    declared.append(second.declare_token(own[1]))
    assert until(lambda: watchers[0].present >= {RobotToken("r1"), own[1]})
    assert until(lambda: watchers[1].present >= {RobotToken("r1"), own[0]})
    again = Watcher()
    end = first.watch_tokens(again)
    assert until(lambda: again.present >= {RobotToken("r1"), own[1]}), "each watch has the tokens of before"
    end()
    robot.close()
    assert until(lambda: all(RobotToken("r1") not in watcher.present for watcher in watchers))
    assert RobotToken("r1") in again.present, "it has ended"
    declared[0]()
    assert until(lambda: own[0] not in watchers[1].present)


def test_a_robot_sees_the_drivers_of_itself_alone_and_their_end(site):
    robot, fleet = site
    driver, before = fleet(1), Watcher()
    declared = [driver.declare_token(DriverToken(robot_id, "a", token))
                for robot_id, token in (("r1", TOKENS[0]), ("r2", TOKENS[1]))]
    robot.watch_drivers(before)
    withdraw = driver.declare_token(DriverToken("r1", "a", TOKENS[2]))
    assert until(lambda: before.present == {TOKENS[0], TOKENS[2]})
    withdraw()
    assert until(lambda: before.present == {TOKENS[0]})
    driver.close()
    assert until(lambda: before.present == set()) and declared
    assert {token for token, _ in before.seen} == {TOKENS[0], TOKENS[2]}


def test_detectors_see_those_of_their_group_and_vision_services_see_none_of_them(site):
    _, fleet = site
    first, second, vision, watchers = fleet(0), fleet(1), fleet(0), [Watcher() for _ in range(3)]
    own = [DetectorToken("0000000a", 1.0, "00000001"), DetectorToken("0000000a", 2.0, "00000002", "r*")]
    other = DetectorToken("0000000b", 1.0, "00000003")
    vision.watch_tokens(watchers[2])
    declared = [first.declare_token(own[0]), first.declare_token(other)]
    ends = [first.watch_detectors("0000000a", watchers[0])]
    declared.append(second.declare_token(own[1]))
    assert until(lambda: watchers[0].present == set(own))
    ends[0]()
    ends.append(first.watch_detectors("0000000a", watchers[1]))
    assert until(lambda: watchers[1].present == set(own)), "a new watch has the tokens of before, also its own"
    second.close()
    assert until(lambda: watchers[1].present == {own[0]})
    assert until(lambda: watchers[2].present == {RobotToken("r1")})
    assert watchers[0].present == set(own)


@pytest.mark.parametrize("number", [0, 1])
def test_another_connection_that_declares_and_withdraws_the_same_token_ends_nothing(site, number):
    robot, fleet = site
    watcher, token = Watcher(), DriverToken("r1", "a", TOKENS[0])
    declared = fleet(1).declare_token(token)
    robot.watch_drivers(watcher)
    assert until(lambda: watcher.present)
    copying = fleet(number)
    for _ in range(100):
        copying.declare_token(token)()
    time.sleep(0.2)
    assert watcher.present == {TOKENS[0]}
    assert not [one for one in watcher.seen if not one[1]]
    declared()
    assert until(lambda: not watcher.present)


def test_on_links_with_keys_each_role_declares_only_its_tokens(tmp_path):
    folder, endpoint = tmp_path / "keys", free_endpoint("tls/")
    keys.make(folder, ["robot.local"])
    secure = str(folder)
    with open_zenoh("r1", listen=[endpoint], role="robot", secure=secure) as robot, ExitStack() as ending:
        drivers, tokens, detectors = Watcher(), Watcher(), Watcher()
        robot.watch_drivers(drivers)
        for role in ("vision", "detector"):
            watching = open_fleet("*", connect=[endpoint], role=role, by_status=False, secure=secure)
            ending.enter_context(watching)
            if role == "vision":
                watching.watch_tokens(tokens)
            else:
                watching.watch_detectors("0000000a", detectors)
        roles = ("viewer", "operator", "detector", "vision")
        for number, role in enumerate(roles):
            peer = ending.enter_context(open_zenoh("r1", connect=[endpoint], role=role, secure=secure))
            session = peer._session
            for token in (DriverToken("r1", role, TOKENS[number]), VisionToken(role, 1.0, f"{number:08x}"),
                          RobotToken(f"robot-of-{role}"), DetectorToken("0000000a", 1.0, f"{number:08x}")):
                ending.callback(declare_token(session, token))
        vision = {DriverToken("r1", "vision", TOKENS[3]), VisionToken("vision", 1.0, "00000003"), RobotToken("r1")}
        assert until(lambda: tokens.present >= vision and drivers.present and detectors.present)
        time.sleep(0.2)
        assert drivers.present == {TOKENS[3]}
        assert detectors.present == {DetectorToken("0000000a", 1.0, "00000002")}
        assert tokens.present == vision
