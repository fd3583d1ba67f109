"""Floor, walls, room, objects and shadows that a look adds to a scenario."""

import colorsys
import math

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import simplejpeg

from sightline.protocol.errors import ConfigError
from sightline.sim.robot import load_robot
from sightline.sim.scenario import Look, Place, Scenario, Static, Wall, load_scenario, look_named, scenario_names
from sightline.sim.world.bodies import LightBodies, ThingBodies
from sightline.sim.world.camera import (
    LIGHT_FROM,
    TEXELS_PER_M,
    TILE_TEXELS,
    WALL_TILE_M,
    SceneCamera,
    ShadowPainter,
    Surfaces,
    WallPainter,
)
from sightline.sim.world.engine import pybullet
from sightline.sim.world.physics import open_client
from sightline.sim.world.surroundings import LEAST_HUE_OFF_DEG, NEEDED_M, needed_area, surfaces, surroundings
from sightline.sim.world.view import Scenery
from sightline.sim.world.world import World
from tests.fixtures.sim import robot_with, seen_at

pytestmark = pytest.mark.computes


def with_look(name: str, **options) -> Scenario:
    return load_scenario(name).model_copy(update={"look": Look(noise=0.0, jpeg_quality=100, **options)})


def image(scenario: Scenario, seed: int = 1) -> np.ndarray:
    with World(scenario, robot_with(), seed) as world:
        for _ in range(50):
            world.step()
        return simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)


def hue_off_deg(color, other) -> float:
    one, two = (360 * colorsys.rgb_to_hsv(*each)[0] for each in (color, other))
    return abs(math.remainder(one - two, 360))


# --- room and objects -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", scenario_names())
def test_room_and_objects_stand_outside_the_area_of_the_scenario(name):
    scenario = load_scenario(name).model_copy(update={"look": look_named("real")})
    left, bottom, right, top = needed_area(scenario)
    room, things = surroundings(scenario, 5)
    assert len(room) == 4 and len(things) == scenario.look.clutter
    for thing in things:
        (x_m, y_m), reach_m = thing.at_m, thing.reach_m
        assert not (left - reach_m < x_m < right + reach_m and bottom - reach_m < y_m < top + reach_m), thing.at_m
        assert left - 1 < x_m < right + 1 and bottom - 1 < y_m < top + 1  # and inside the room
    for wall in room:
        assert not (left < wall.start_m[0] < right or bottom < wall.start_m[1] < top)
    for thing in scenario.things:
        if thing.kind == "static":
            assert left < thing.at_m[0] < right and bottom < thing.at_m[1] < top
    for x_m, y_m in [*scenario.goals_m, *(end for wall in scenario.walls for end in (wall.start_m, wall.end_m))]:
        assert left < x_m < right and bottom < y_m < top


@pytest.mark.parametrize("name", ["ball-eight", "pushed", "chaser", "legs-crowd", "walls"])
def test_target_and_start_of_the_robot_are_inside_the_area(name):
    scenario = load_scenario(name)
    left, bottom, right, top = needed_area(scenario)
    with World(scenario, load_robot(scenario.robot), 5) as world:
        for _ in range(20):
            truth = world.truth()
            for x_m, y_m in ((truth.x_m, truth.y_m), (truth.target_x_m, truth.target_y_m)):
                assert left + 0.5 < x_m < right - 0.5 and bottom + 0.5 < y_m < top - 0.5
            for _ in range(250):
                world.step()


def test_area_contains_the_whole_way_of_a_ball_that_rolls():
    pushed, chaser = needed_area(load_scenario("pushed")), needed_area(load_scenario("chaser"))
    around_m = NEEDED_M + 1.0  # the largest distance at the start
    assert pushed == pytest.approx((-1.5 - around_m, -1.5 - around_m, 1.5 + around_m, 1.5 + around_m))
    assert chaser.right_m > 0.12 * 60  # its speed, for a minute


def test_objects_have_colors_near_the_targets_and_others_but_never_its_own():
    for name in ("circle", "blocks", "blocks-red", "blue-sphere"):
        scenario = with_look(name, clutter=20)
        things = surroundings(scenario, 3).things
        assert len(things) == 20
        off_deg = [hue_off_deg(thing.color, scenario.target.color) for thing in things]
        assert min(off_deg) >= LEAST_HUE_OFF_DEG - 1e-6
        assert sum(off < 60.001 for off in off_deg) == 10
        assert len({thing.shape for thing in things}) == 3


def test_objects_and_room_are_bodies_that_a_range_sensor_measures():
    def nearest_m(**options) -> float:
        with World(with_look("circle", **options), load_robot("raspberry"), 3) as world:
            ranges = np.array(world.scan().ranges_m)
            return float(ranges[np.isfinite(ranges) & (ranges > 1.3)].min(initial=99.0))  # the ball is nearer

    assert nearest_m() == 99.0
    assert nearest_m(room_m=1.0) < 6.0
    assert nearest_m(clutter=20) < 6.0


def test_surroundings_are_of_the_seed():
    scenario = load_scenario("circle").model_copy(update={"look": look_named("real")})
    assert surroundings(scenario, 3) == surroundings(scenario, 3)
    assert surroundings(scenario, 3).things != surroundings(scenario, 4).things
    assert np.array_equal(surfaces(scenario, 3).floor, surfaces(scenario, 3).floor)
    assert not np.array_equal(surfaces(scenario, 3).floor, surfaces(scenario, 4).floor)


@pytest.mark.parametrize("name", ["circle", "pushed", "legs-crowd"])
def test_look_changes_no_motion(name):
    """Neither what robot and target do for the same wheel speeds, nor where they begin."""
    def truths(look: str) -> list:
        scenario = load_scenario(name).model_copy(update={"look": look_named(look)})
        with World(scenario, load_robot(scenario.robot), 4) as world:
            world.set_wheels(5.0, 4.0)
            found = []
            for _ in range(5):
                for _ in range(80):
                    world.step()
                world.render()
                found.append(world.truth())
            return found

    for plain, real in zip(truths("plain"), truths("real"), strict=True):
        for key in ("x_m", "y_m", "yaw_rad", "target_x_m", "target_y_m", "bearing_rad", "distance_m"):
            assert getattr(real, key) == pytest.approx(getattr(plain, key), abs=1e-9)
        assert (real.visible, real.wall_contacts) == (plain.visible, plain.wall_contacts)


# --- floor, walls, shadows --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["circle", "blocks", "legs"])
def test_floor_has_the_hue_of_the_target_and_its_share_of_saturation(name):
    scenario = with_look(name, floor="mosaic", floor_likeness=0.4)
    floor = image(scenario)[180:].mean(axis=(0, 1)) / 255
    wanted = 0.4 * colorsys.rgb_to_hsv(*scenario.target.color)[1]
    assert colorsys.rgb_to_hsv(*floor)[1] == pytest.approx(wanted, rel=0.2)
    assert hue_off_deg(floor, scenario.target.color) < 6
    gray = image(with_look(name, floor="mosaic"))[180:].mean(axis=(0, 1))
    assert np.ptp(gray) < 6


def facing_a_wall(away_m: float, look: Look, backward_rad_s: float = 0.0) -> tuple[np.ndarray, float]:
    """Return the image of a wall straight ahead, and the distance to it once the robot has driven back for 1.6 s."""
    scenario = seen_at(20.0, 180.0)
    with World(scenario, robot_with(), 1) as world:
        model, truth = world.camera_model, world.truth()
    cos, sin = math.cos(truth.yaw_rad), math.sin(truth.yaw_rad)
    lens = (truth.x_m + model.x_m * cos, truth.y_m + model.x_m * sin)
    ends = [(lens[0] + away_m * cos - s * sin, lens[1] + away_m * sin + s * cos) for s in (-3, 3)]
    wall = Wall(start_m=ends[0], end_m=ends[1], thickness_m=0.001, height_m=2.0)
    with World(scenario.model_copy(update={"walls": (wall,), "look": look}), robot_with(), 1) as world:
        world.set_wheels(-backward_rad_s, -backward_rad_s)
        for _ in range(400):
            world.step()
        moved_m = math.dist((world.truth().x_m, world.truth().y_m), (truth.x_m, truth.y_m))
        return simplejpeg.decode_jpeg(world.render(), "RGB").astype(float), away_m + moved_m


@pytest.mark.parametrize("texture", ["boards", "clouds", "bricks", "marble", "mosaic", "stones", "weave"])
def test_wall_has_its_texture_and_the_hue_of_the_target(texture):
    def wall(**options) -> np.ndarray:
        return facing_a_wall(2.0, Look(noise=0.0, jpeg_quality=100, **options))[0][10:110]

    plain, painted = wall(), wall(wall=texture, wall_likeness=0.3)
    assert plain.std(axis=(0, 1)).max() < 1.5
    assert painted.std(axis=(0, 1)).max() > 4
    color = painted.mean(axis=(0, 1)) / 255
    assert hue_off_deg(color, (0.95, 0.78, 0.05)) < 6
    assert colorsys.rgb_to_hsv(*color)[1] == pytest.approx(0.3 * 0.947, rel=0.2)
    assert np.abs(wall(wall=texture).mean(axis=(0, 1)) - plain.mean(axis=(0, 1))).max() < 12  # its own color


def pattern(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return a smooth tile by the coordinates of its texels, as shares of its side. No two places look alike."""
    waves = 0.2 * np.sin(math.tau * along) * np.cos(math.tau * across)
    return np.asarray(0.75 + waves + 0.05 * np.cos(math.tau * (along + across)))


@pytest.mark.parametrize("yaw_deg", [0.0, 25.0])
@pytest.mark.parametrize("lens_m", [(0.0, 0.0, 0.1), (0.3, -0.7, 0.4)])
def test_texture_of_a_wall_is_where_the_pinhole_model_has_it(lens_m, yaw_deg):
    """The wall stands across the x axis at 2 m, so a point of it has the coordinates y and z."""
    model, size = robot_with().camera.camera_model(), 128
    texels = np.arange(size) / size
    wall = Wall(start_m=(2.0, 4.0), end_m=(2.0, -4.0), thickness_m=0.001, height_m=3.0, color=(1.0, 1.0, 1.0))
    tile = pattern(texels, texels[:, None]).astype(np.float32)
    painter = WallPainter((wall,), model, [-1.0, 0.0, 0.0], 0.002, tile)
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    axes = np.array([[sin, 0.0, cos], [-cos, 0.0, sin], [0.0, -1.0, 0.0]])  # right, down, forward
    image_ = np.zeros((model.height_px, model.width_px, 3), np.uint8)
    painter.paint(image_, np.array(lens_m), axes)
    for row, column in ((20, 30), (60, 160), (100, 250), (110, 90)):
        ray = axes @ [(column + 0.5 - model.cx_px) / model.fx_px, (row + 0.5 - model.cy_px) / model.fy_px, 1.0]
        _, y_m, z_m = np.array(lens_m) + ray * (2.0 - lens_m[0]) / ray[0]
        expected = 255 * pattern(-y_m / WALL_TILE_M, -z_m / WALL_TILE_M)
        assert image_[row, column, 0] == pytest.approx(expected, abs=4), (row, column)


@pytest.mark.parametrize("yaw_deg", [0.0, 40.0])
@pytest.mark.parametrize("lens_m", [(0.0, 0.0, 0.12), (0.7, -1.3, 0.3)])
def test_texture_of_the_floor_is_where_the_pinhole_model_has_it(lens_m, yaw_deg):
    model, texels = robot_with().camera.camera_model(), np.arange(TILE_TEXELS) / TILE_TEXELS
    tile = np.repeat(255 * pattern(texels, texels[:, None])[..., None], 3, axis=-1).astype(np.uint8)
    client = open_client(4000)
    try:
        camera = SceneCamera(client, model, (), 1, surfaces=Surfaces(floor=tile))
        turn = pybullet.getQuaternionFromEuler([0, 0, math.radians(yaw_deg)])
        image_ = camera.draw(lens_m, turn)
    finally:
        pybullet.disconnect(client)
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    axes = np.array([[sin, 0.0, cos], [-cos, 0.0, sin], [0.0, -1.0, 0.0]])
    for row, column in ((235, 30), (210, 200), (180, 100), (160, 250), (145, 160)):
        ray = axes @ [(column + 0.5 - model.cx_px) / model.fx_px, (row + 0.5 - model.cy_px) / model.fy_px, 1.0]
        x_m, y_m, _ = np.array(lens_m) - ray * lens_m[2] / ray[2]
        wide_m = TILE_TEXELS / TEXELS_PER_M
        assert image_[row, column, 0] == pytest.approx(255 * pattern(x_m / wide_m, y_m / wide_m), abs=5), (row, column)


def test_texture_stays_on_its_wall_while_the_robot_moves():
    """The same point of the wall has the same brightness from two places, though it is elsewhere in the image."""
    look, model = Look(noise=0.0, jpeg_quality=100, wall="stones"), robot_with().camera.camera_model()
    spots = [(right_m, up_m) for right_m in np.linspace(-0.5, 0.5, 15) for up_m in np.linspace(0.05, 0.4, 8)]
    brightness, distances_m = [], []
    for backward_rad_s in (0.0, 6.0):
        rgb, away_m = facing_a_wall(1.0, look, backward_rad_s)
        columns = [round(model.cx_px + model.fx_px * right_m / away_m - 0.5) for right_m, _ in spots]
        rows = [round(model.cy_px - model.fy_px * (up_m - model.z_m) / away_m - 0.5) for _, up_m in spots]
        brightness.append(rgb[rows, columns, 0])
        distances_m.append(away_m)
    assert distances_m[1] > distances_m[0] + 0.25
    assert np.corrcoef(*brightness)[0, 1] > 0.85


def test_shadow_darkens_the_floor_beside_the_ball_by_its_share():
    scenario = seen_at(0.8, 0.0)
    light, shaded = (
        image(scenario.model_copy(update={"look": Look(noise=0.0, jpeg_quality=100, shadows=part)}))
        for part in (0.0, 0.5)
    )
    ratio = shaded.sum(axis=-1) / np.maximum(light.sum(axis=-1), 1)
    ball = light[..., 0] - light[..., 2] > 60
    floor = np.zeros_like(ball)
    floor[130:] = True
    floor &= ~ball
    assert np.quantile(ratio[floor], 0.5) == pytest.approx(1.0, abs=0.02)
    assert ratio[floor].min() == pytest.approx(0.5, abs=0.06)
    dark = np.argwhere(floor & (ratio < 0.75))
    rows, columns = np.nonzero(ball)
    assert len(dark) > 30
    assert rows.max() - 12 < dark[:, 0].mean() < rows.max() + 12
    assert columns.min() - 40 < dark[:, 1].mean() < columns.max() + 40


def test_shadow_falls_away_from_the_light():
    """A box of known height: the far corner of its shadow is where the ray of the light meets the floor."""
    model = robot_with().camera.camera_model()
    corners = np.array([[x, y, z] for x in (1.9, 2.1) for y in (-0.1, 0.1) for z in (0.0, 0.4)])
    image_ = np.full((model.height_px, model.width_px, 3), 200, np.uint8)
    seen_axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    lens = np.array([0.0, 0.0, 1.0])
    ShadowPainter(model, 0.5).paint(image_, [corners], lens, seen_axes)
    rows, columns = np.nonzero(image_[..., 0] < 150)
    tip = np.array([1.9 - 0.4 * LIGHT_FROM[0], -0.1 - 0.4 * LIGHT_FROM[1]])  # nearest to the lens, and to the right
    assert rows.max() == pytest.approx(model.cy_px + model.fy_px * 1.0 / tip[0], abs=2.5)
    assert columns.max() == pytest.approx(model.cx_px - model.fx_px * tip[1] / tip[0], abs=2.5)


def test_hull_of_a_body_is_where_the_body_is():
    client = open_client(4000)
    try:
        box = Static(shape="box", size_m=(0.4, 0.2, 0.6))
        (hull,) = ThingBodies(client, box, Place(1.0, 2.0, math.radians(30)), is_target=False).hulls()
        cos, sin = math.cos(math.radians(30)), math.sin(math.radians(30))
        corner = [1.0 + 0.2 * cos - 0.1 * sin, 2.0 + 0.2 * sin + 0.1 * cos, 0.6]
        assert np.linalg.norm(hull - corner, axis=1).min() < 1e-6
        legs = Static(shape="legs", radius_m=0.05, height_m=0.42)
        both = ThingBodies(client, legs, Place(0.0, 0.0, 0.0), is_target=False).hulls()
        assert len(both) == 2
        for hull in both:
            assert (hull[:, 2].min(), hull[:, 2].max()) == pytest.approx((0.0, 0.42), abs=1e-6)
            assert np.ptp(hull[:, 0]) == pytest.approx(0.1, abs=1e-6)
    finally:
        pybullet.disconnect(client)


def test_walls_and_traffic_lights_throw_shadows():
    client = open_client(4000)
    try:
        lane = load_scenario("traffic-light")
        assert len(Scenery(client, lane, (), LightBodies(client, lane.light, 0.0)).hulls()) == 2  # pole and housing
        assert len(Scenery(client, load_scenario("walls"), (), None).hulls()) == 5
    finally:
        pybullet.disconnect(client)


# --- the preset, and bad values ---------------------------------------------------------------------------------------


def test_preset_real_has_every_option():
    off = Look().model_dump()
    used = {name for name, value in look_named("real").model_dump().items() if value != off[name]}
    drawn_otherwise = {"exposure", "saturation", "white_balance"}  # constant factors, which drift covers
    periods = {"exposure_period_s", "white_balance_period_s"}
    assert used | periods == off.keys() - drawn_otherwise - {"lens_known"}


@pytest.mark.parametrize(("text", "expected"), [
    ("shadows = 1.5", "look.shadows"), ("clutter = -1", "look.clutter"), ("room_m = 99.0", "look.room_m"),
    ('floor = "lava"', "look.floor"), ("floor_likeness = 2", "look.floor_likeness"),
    ('wall = "lava"', "look.wall"), ("wall_likeness = nan", "look.wall_likeness"),
    ("latency_ms = 501", "look.latency_ms"), ("latency_ms = 1.5", "look.latency_ms"),
    ("distortion = [0.1, 0.2, 0, 0, 0, 0]", "look.distortion"), ("distortion = [-2.0]", "look.distortion.0"),
    ('lens_known = "perhaps"', "look.lens_known"),
    ("rolling_shutter_ms = -1", "look.rolling_shutter_ms"), ("motion_blur_ms = 101", "look.motion_blur_ms"),
    ("exposure_drift = 1.1", "look.exposure_drift"), ("exposure_period_s = 0", "look.exposure_period_s"),
    ("white_balance_drift = inf", "look.white_balance_drift"),
    ("white_balance_period_s = -1", "look.white_balance_period_s"),
    ("shadow = 0.5", "unknown key, did you mean 'shadows'?"),
])
def test_bad_option_of_a_look_is_one_clear_line(tmp_path, text, expected):
    (tmp_path / "mine.toml").write_text(f'extends = "circle"\n[look]\n{text}\n')
    with pytest.raises(ConfigError) as caught:
        load_scenario(str(tmp_path / "mine.toml"))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
