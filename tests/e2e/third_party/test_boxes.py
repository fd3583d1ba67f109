"""Boxes from a legacy program on port 9091 reach a vision service on Zenoh through a real robot, which stays alive."""

import pytest
from websockets.sync.client import connect

from sightline.protocol.channels import DETECTIONS, MAX_HEADER_BYTES
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import Detections, DetectionsHeader
from sightline.protocol.transports.zenoh.link import open_zenoh
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision


@pytest.fixture
def robot(tmp_path):
    older = free_endpoint("ws-legacy://") + "?boxes"
    with RobotProcess(tmp_path, listen=[zenoh := free_endpoint(), older], safety={"guests": True}) as running:
        running.endpoint = zenoh
        running.wait_until_on()
        yield running, older.replace("ws-legacy", "ws").removesuffix("?boxes")


def test_boxes_of_a_legacy_program_reach_zenoh_and_name_their_frame(robot):
    process, older = robot
    with open_zenoh("r1", connect=[process.endpoint], role="vision") as vision, connect(older) as program:
        heard = []
        vision.subscribe(DETECTIONS, heard.append)

        def arrived():
            program.recv(timeout=2)  # a picture to look at
            program.send("leg,0.25,0.5,0.75,1")
            return heard

        assert until(arrived, 5)
        message = heard[0]
        assert message.source == "guest"
        header = decode(DetectionsHeader, message.header, MAX_HEADER_BYTES)
        (box,) = decode(Detections, message.payload, DETECTIONS.max_payload_bytes).boxes
        assert (box.label, box.x1_px, box.y1_px, box.x2_px, box.y2_px) == ("leg", 4, 8, 12, 16)
        assert header.echo.channel == "frame"


@pytest.mark.slow
def test_detector_on_zenoh_does_not_delay_the_robot(robot):
    process, _older = robot
    found = Detections(width_px=16, height_px=16, boxes=())
    with (
        open_zenoh("r1", connect=[process.endpoint], role="vision") as detector,
        Vision(process.endpoint) as vision,
    ):
        assert until(lambda: len(vision.headers) > 10)
        for seq in range(200):
            header = DetectionsHeader(source="vision", session="0000dddd", seq=seq)
            detector.publish(DETECTIONS, encode(header), encode(found))
        before = len(vision.headers)
        assert until(lambda: len(vision.headers) > before + 30, 5), "frames go on"
