"""The drops of every slot, from the counter to the text of `sightline status`; and captures without a reader."""

import socket
import threading
import time
from collections import Counter

from sightline.operator_side.client.status import drops_text, encoding_text, status_lines
from sightline.protocol.channels import FRAME
from sightline.protocol.messages import CameraModel, State, Status, StreamStatus
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.open import LinkGroup
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.hardware.cameras.timing import LatestPicture
from sightline.robot_side.network.process import NetworkProcess
from sightline.robot_side.pipe import NetworkEnd, NetworkSetup
from sightline.robot_side.ports import Picture
from tests.fixtures.cameras import jpeg
from tests.fixtures.links import until

OPEN = []
"""The network process ends with its driver's sockets, and here it would take the tests with it: they stay open."""


class CountingCamera:
    """A camera that counts its reads."""

    model = CameraModel(width_px=64, height_px=64, fx_px=50, fy_px=50, cx_px=32, cy_px=32)
    live = True

    def __init__(self):
        self.captures = 0
        self.picture = jpeg(64, 64)

    def read(self, timeout_s):
        self.captures += 1
        time.sleep(0.005)
        return Picture(self.picture, time.monotonic_ns() // 1000)

    def close(self):
        pass


def running(link, camera):
    """The network process's own loop, here as a thread; its driver's ends stay open and silent."""
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
    setup = NetworkSetup(config=RobotConfig(), session="0000aaaa", first_seq=0)
    OPEN.extend(pairs)
    network = NetworkProcess(setup, NetworkEnd(*(theirs for _, theirs in pairs)), link, camera)
    threading.Thread(target=network.run, daemon=True).start()
    return network, pairs


def test_camera_without_a_listener_captures_nothing():
    joined, camera = MemoryNetwork(), CountingCamera()
    network, pairs = running(joined.link("r1"), camera)
    assert pairs[0][0].recv(64), "it reports that it is ready"
    time.sleep(0.5)
    assert camera.captures == 0
    viewer = joined.link("r1", "viewer")
    viewer.subscribe(FRAME, lambda _message: None)
    assert until(lambda: camera.captures > 0)
    network.running = False


class CountingLink:
    """The counters of the link."""

    robot = "r1"

    def __init__(self, dropped, rejected):
        self.dropped, self.rejected = Counter(dropped), Counter(rejected)


def test_several_links_count_together():
    counted = ({"frame": 3}, {"OVERSIZE": 1}), ({}, {}), ({"frame": 4}, {})
    links = LinkGroup([CountingLink(*counts) for counts in counted])
    assert links.dropped == {"frame": 7} and links.rejected == {"OVERSIZE": 1}


def test_camera_slot_counts_images_that_were_not_taken():
    newest = LatestPicture()
    for number in range(4):
        newest.put(Picture(b"", number))
    assert newest.dropped == 3


def test_drops_are_formatted_as_text():
    assert drops_text(StreamStatus()) == "nothing"
    stream = StreamStatus(
        dropped={"frame": 12, "scan": 1}, missed_captures=40, overtaken=5, refused_pictures=2, quality_percent=60,
        scale_percent=50,
    )
    words = drops_text(stream)
    parts = ("40 captures in the camera's slot", "12 frame before sending", "5 frames overtaken", "2 invalid images")
    for part in parts:
        assert part in words
    assert encoding_text(stream) == "reduced for this link: quality 60 %, side length 50 %"
    assert encoding_text(StreamStatus()) == "as configured"
    shown = "\n".join(status_lines("r1", Status(state=State.HOLD, reason="waiting", stream=stream)))
    assert words in shown and encoding_text(stream) in shown
