"""The simulation's own labels: boxes of legs where the picture has them, and their way over the bus."""

import json
import math

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import numpy as np
import simplejpeg

from sightline.evaluation.labels import LabelPublisher, Labels, boxes_message
from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import Detections, DetectionsHeader, FrameHeader
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.sim.bus import Label, LabelReader, SimCamera, TruthReader, to_json
from sightline.sim.scenario import Wall, load_scenario
from sightline.sim.world.world import World
from sightline.vision_side.config import BoxesConfig
from tests.fixtures.sim import robot_with, seen_at
from tests.sim.test_bus import eventually, started


def world_of(distance_m=1.2, bearing_deg=0.0, walls=(), seed=1) -> World:
    scenario = seen_at(distance_m, bearing_deg, "legs")
    return World(scenario.model_copy(update={"walls": walls}), robot_with(), seed)


@pytest.mark.parametrize("distance_m", [0.7, 1.2, 2.5])
@pytest.mark.parametrize("bearing_deg", [-20.0, 0.0, 25.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_box_holds_both_legs_and_nothing_else(distance_m, bearing_deg, seed):
    with world_of(distance_m, bearing_deg, seed=seed) as world:
        (label,) = world.labels()
        rgb = simplejpeg.decode_jpeg(world.render(), "RGB").astype(int)
    rows, columns = np.nonzero((rgb.max(axis=-1) < 75) & (rgb[..., 2] > rgb[..., 0] + 8))
    assert label.label == "legs"
    assert label.score > 0.8 or distance_m < 1.0  # one leg may hide part of the other
    drawn = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    assert drawn == pytest.approx((label.x1_px, label.y1_px, label.x2_px, label.y2_px), abs=2.5)


def test_who_is_behind_a_wall_or_behind_the_robot_has_no_box():
    with world_of(1.5) as world:
        truth = world.truth()
    along, across = truth.yaw_rad, truth.yaw_rad + math.pi / 2
    foot = (truth.x_m + 0.7 * math.cos(along), truth.y_m + 0.7 * math.sin(along))
    ends = [(foot[0] + side * math.cos(across), foot[1] + side * math.sin(across)) for side in (-1.0, 1.0)]
    with world_of(1.5, walls=(Wall(start_m=ends[0], end_m=ends[1], height_m=0.6),)) as world:
        assert world.labels() == ()
    with world_of(1.5, 170.0) as world:
        assert world.labels() == ()


def test_others_are_labelled_too_and_a_scenario_without_labels_has_none():
    crowd = load_scenario("legs-crowd").model_copy(update={"labels": "legs"})
    with World(crowd, robot_with(), 3) as world:
        counts = set()
        for _ in range(13):
            for _ in range(250):  # the first of the others crosses after 12 s
                world.step()
            counts.add(len(world.labels()))
    assert max(counts) >= 2
    with World(load_scenario("circle"), robot_with(), 3) as world:
        assert world.labels() == ()


def test_labels_become_the_boxes_of_the_frame_they_are_of():
    with world_of() as world:
        camera, labels = world.camera_model, world.labels()
    frame = FrameHeader(session="00000001", seq=7, t_us=5)
    header, payload = boxes_message(frame, [one._asdict() for one in labels], camera, "00000002", 3)
    stamp, found = decode(DetectionsHeader, header), decode(Detections, payload, 65_536)
    assert (stamp.echo.session, stamp.echo.seq, stamp.echo.t_us) == ("00000001", 7, 5)
    assert (found.width_px, found.height_px, len(found.boxes)) == (camera.width_px, camera.height_px, 1)
    lockstep = Labels(BoxesConfig(label="legs"), camera)
    lockstep.label(frame, labels)
    answered, (seen,) = lockstep.of(frame)
    assert answered == frame
    assert (seen.label, seen.x1_px, seen.y2_px) == ("legs", labels[0].x1_px, labels[0].y2_px)


def test_reader_of_truth_ignores_labels():
    message = to_json([Label("legs", 1.0, 1.0, 2.0, 3.0, 4.0)], 17, 320)
    assert b'"t_us"' not in message, "this field identifies a truth"
    assert json.loads(message)["labelled_us"] == 17


def assert_boxes_of_a_smaller_picture(labels, camera) -> None:
    """Labels of a frame at half size are in the pixels of that frame."""
    network, heard = MemoryNetwork(), []
    robot, person = network.link("r1"), network.link("r1", role="guest")
    robot.subscribe(DETECTIONS, heard.append)
    publisher = LabelPublisher(person, labels)
    while (picture := camera.read(1.0)) is None or picture.scale_percent != 50:
        pass
    robot.publish(FRAME, encode(FrameHeader(session="00000001", seq=1, t_us=picture.t_us)), picture.jpeg)
    network.advance(1)
    publisher.step()
    network.advance(2)
    found = decode(Detections, heard[0].payload, 65_536)
    assert (found.width_px, found.height_px) == (160, 120)
    whole = labels.of(picture.t_us, 320)
    assert [box.x1_px for box in found.boxes] == [pytest.approx(box["x1_px"] / 2) for box in whole]


def test_a_running_simulation_labels_the_picture_that_it_sends(tmp_path):
    simulator = started(tmp_path, scenario="legs")
    try:
        labels, truth = LabelReader(simulator.socket_dir), TruthReader(simulator.socket_dir)
        camera = SimCamera(simulator_config(simulator))
        assert truth.simulated.robot == "raspberry", "the scenario's own"
        seen = []

        def labelled() -> bool:
            labels.drain()
            picture = camera.read(1.0)
            boxes = labels.of(picture.t_us, 320) if picture else None
            seen.append(boxes)
            return boxes is not None and truth.read(1.0) is not None

        eventually(labelled)
        assert labels.of(1, 320) is None
        assert camera.adjust(80, 50)
        assert_boxes_of_a_smaller_picture(labels, camera)
    finally:
        simulator.process.kill()
        simulator.process.wait(10)


def simulator_config(simulator) -> SimCamera.Config:
    return SimCamera.Config(socket_dir=simulator.socket_dir)
