"""Several detector services over real Zenoh sessions: each frame examined by one of them, also when one ends."""

import threading
import time
from contextlib import ExitStack, closing

import pytest

from sightline.protocol.channels import DETECTIONS, FRAME, STATUS
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import DetectionsHeader, FrameHeader, Stamp, State, Status
from sightline.protocol.transports.tokens import DetectorToken, RobotToken
from sightline.protocol.transports.zenoh.link import declare_token, open_fleet, open_zenoh
from sightline.protocol.transports.zenoh.session import open_session
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import DetectFrame, Detection, Maker, result_of
from sightline.vision_side.detect.remote.zenoh_detector import ZenohDetector
from sightline.vision_side.serving import detector_sharing
from sightline.vision_side.serving.detector_service import ROLE, DetectorService, ServingOptions
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.vision.remote import BALL_JPEG, within

NAMES = [f"r{number}" for number in range(8)]
GROUP = "f3299829"
"""Of the services with the model of `Finder`."""
BOX = Detection(10.0, 10.0, 50.0, 50.0, 0.9, "ball")


class Finder:
    """A detector that finds one box in each frame, and remembers the robots."""

    maker = Maker("finder", "0123456789abcdef", "cpu")

    def __init__(self):
        self.robots = []

    def detect(self, frames, deadline_us):
        self.robots += [one.robot for one in frames]
        return [result_of(one, (BOX,), self.maker) for one in frames]


class Site:
    """A router with robots, and detector services that come and go."""

    def __init__(self, ending):
        self.endpoint, self._ending, self.seq = free_endpoint(), ending, 0
        session = ending.enter_context(closing(open_session([self.endpoint], (), 5.0)))
        assert session
        self.links = {name: self.opened(open_zenoh(name, connect=[self.endpoint], role="robot")) for name in NAMES}
        self.answers = []
        """Robot, frame and service of each answer."""
        for name, link in self.links.items():
            link.subscribe(DETECTIONS, lambda message, name=name: self._note(name, message))
        self.services, self.lines = [], []

    def opened(self, link):
        return self._ending.enter_context(link)

    def _note(self, robot, message):
        header = decode(DetectionsHeader, message.header)
        self.answers.append((robot, header.echo.seq, header.session))

    def service(self, share=True):
        """Start one more service; returns what ends it."""
        lines, over = [], threading.Event()
        fleet_link = self.opened(open_fleet("*", connect=[self.endpoint], role=ROLE, by_status=not share))
        service = DetectorService(fleet_link, Finder(), ServingOptions("finder", 1_000_000), lines.append)
        # Of two random ones, one in 128 pairs leaves all robots to one service.
        service._session = f"0a0a0a{len(self.lines):02x}"
        if share:
            service.join(1.0, "*")
        thread = threading.Thread(target=service.serve, args=(over,), daemon=True)
        thread.start()

        def stop():
            over.set()
            thread.join(5)

        def end():
            fleet_link.close()
            stop()
            self.services.remove(service)

        self._ending.callback(stop)
        self.services.append(service)
        self.lines.append(lines)
        return end

    def send(self, *names):
        """Let each robot send its status and one frame. Services that share find it by its token."""
        for name in names or NAMES:
            self.seq += 1
            stamp = {"session": "0000abcd", "seq": self.seq, "t_us": self.seq * 1_000}
            self.links[name].publish(STATUS, encode(Stamp(**stamp)), encode(Status(state=State.HOLD, reason="test")))
            self.links[name].publish(FRAME, encode(FrameHeader(**stamp)), BALL_JPEG)
        return FrameHeader(**stamp)

    def serving(self):
        """Return how many robots each service serves."""
        return [int(service.about().partition(": ")[2].split()[0]) for service in self.services]

    def settled(self, services, each=1):
        """Return True once every robot is served by `each` services, of `services` altogether."""

        def is_settled():
            self.send()
            time.sleep(0.01)
            serving = self.serving()
            return len([one for one in serving if one]) == services and sum(serving) == each * len(NAMES)

        return until(is_settled)


@pytest.fixture
def site():
    with ExitStack() as ending:
        yield Site(ending)


def answers_of_a_round(site, each=1):
    """Let each robot send one frame, which so many services answer. Returns how many answers came to each."""
    time.sleep(0.05)
    site.answers.clear()
    first = site.seq
    site.send()
    assert until(lambda: len({seq for _, seq, _ in site.answers if seq > first}) == len(NAMES))
    assert until(lambda: sum(seq > first for _, seq, _ in site.answers) >= each * len(NAMES))
    time.sleep(0.05)
    return [sum(one[1] == seq for one in site.answers) for seq in range(first + 1, site.seq + 1)]


def test_services_without_share_both_examine_every_frame(site):
    site.service(share=False)
    site.service(share=False)
    assert site.settled(2, 2)
    assert answers_of_a_round(site, 2) == [2] * len(NAMES)


def test_each_frame_is_examined_by_one_of_several_services(site):
    for _ in range(2):
        site.service()
    assert site.settled(2)
    assert answers_of_a_round(site) == [1] * len(NAMES)
    assert "of 2 services" in site.services[0].about()


def test_robots_of_a_service_that_ends_move_to_the_next_in_time(site):
    ends = [site.service() for _ in range(2)]
    assert site.settled(2)
    robot = next(name for name, duty in site.services[0]._duties.items() if duty is detector_sharing.Duty.SERVE)
    detector = ZenohDetector(ZenohDetector.Config())
    detector.attach(site.opened(open_zenoh(robot, connect=[site.endpoint])))

    def is_answered(seconds):
        frame = DetectFrame(robot, site.send(robot), BALL_JPEG, Decoder(320, 240, 320 * 240))
        return detector.detect([frame], within(seconds))[0]

    assert until(lambda: is_answered(0.2))
    ends[0]()
    site.answers.clear()
    assert any(is_answered(0.2) for _ in range(3))
    assert site.settled(1), "all of its robots"
    assert not any("several services" in line for line in detector.notices())
    assert len(site.answers) == len({one[:2] for one in site.answers}), "no frame is answered twice"


def test_service_that_joins_takes_its_robots_when_it_answers(site):
    site.service()
    assert site.settled(1)
    site.service()
    assert site.settled(2) and answers_of_a_round(site) == [1] * len(NAMES)
    assert "detector: 2 services share the robots" in site.lines[0]


def test_detector_is_warm_before_its_service_joins(site):
    site.service()
    assert site.services[0]._detector.robots == [""]


@pytest.mark.parametrize("silent", [1, 4])
def test_tokens_that_never_answer_leave_no_robot_without_answers(site, monkeypatch, silent):
    """A service with a hanging detector, or none at all behind a token."""
    monkeypatch.setattr(detector_sharing, "SILENT_US", 100_000)
    monkeypatch.setattr(detector_sharing, "UNANSWERED_US", 50_000)
    mute = site.opened(open_fleet("*", role=ROLE, connect=[site.endpoint]))
    ends = [mute.declare_token(DetectorToken(GROUP, 1000.0, f"fffffff{number}")) for number in range(silent)]
    site.service()
    assert site.settled(1) and answers_of_a_round(site) == [1] * len(NAMES)
    assert f"of {silent + 1} services" in site.services[0].about()
    for withdraw in ends:
        withdraw()
    assert until(lambda: "of 1 services" in site.services[0].about())


def test_share_that_no_other_service_would_accept_is_an_error(site):
    for weight, robots in ((0.0, "*"), (float("nan"), "*"), (1e9, "*"), (1.0, "a/b")):
        service = DetectorService(site.opened(open_fleet("*", connect=[site.endpoint], role=ROLE)), Finder(),
                                  ServingOptions("finder"), print)
        with pytest.raises(ConfigError, match="invalid share"):
            service.join(weight, robots)


def test_service_without_share_is_reported_once(site):
    site.service(share=False)
    site.service()
    assert site.settled(2, 2)
    assert until(lambda: (site.send(), any("also detects" in line for line in site.lines[1]))[1])
    site.send()
    assert sum("start it with --share" in line for line in site.lines[1]) == 1 and not any(site.lines[0][8:])


def test_flood_of_tokens_ends_the_sharing_and_no_answers(site, monkeypatch):
    """A service that comes in the flood shares after it, although its token did not fit."""
    monkeypatch.setattr(detector_sharing, "MAX_SERVICES", 4)
    monkeypatch.setattr(detector_sharing, "MAX_KEPT_TOKENS", 8)
    site.service()
    assert site.settled(1)
    with closing(open_session((), [site.endpoint], 5.0)) as flood:
        declared = [declare_token(flood, DetectorToken(GROUP, 1.0, f"{number:08x}")) for number in range(9)]
        assert until(lambda: any("more services than sharing supports" in line for line in site.lines[0]))
        site.service()
        assert site.settled(2, 2) and len(declared) == 9
        assert answers_of_a_round(site, 2) == [2] * len(NAMES), "as without sharing"
    assert site.settled(2) and answers_of_a_round(site) == [1] * len(NAMES)
    assert all("detector: 2 services share the robots" in lines for lines in site.lines)


def test_robots_that_come_in_a_flood_of_tokens_are_served_after_it(site, monkeypatch):
    monkeypatch.setattr(detector_sharing, "MAX_ROBOTS", 4)
    monkeypatch.setattr(detector_sharing, "LEFT_US", 100_000)
    for name in NAMES[:-1]:
        site.links.pop(name).close()
    with closing(open_session((), [site.endpoint], 5.0)) as flood:
        declared = [declare_token(flood, RobotToken(f"f{number}")) for number in range(9)]
        late = site.opened(open_zenoh("r9", connect=[site.endpoint], role="robot"))
        site.service()
        assert until(lambda: site.serving() == [4]) and len(declared) == 9 and late.connected
    assert until(lambda: set(site.services[0]._duties) == {NAMES[-1], "r9"})
