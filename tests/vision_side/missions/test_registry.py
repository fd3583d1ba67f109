"""Missions: the contract over all that there are, the choice of one, and the legacy laws with their own numbers."""

import math
import re
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from sightline.protocol.config import Config as Settings
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import STILL, CameraModel, FrameHeader, MissionRequest
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.port import Circle, Detection
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.missions.registry import REGISTRY, configured_mission, mission_spec, requested_mission
from tests.contracts.missions import CAMERA, check_mission
from tests.fixtures.plugins import with_entries

pytestmark = pytest.mark.computes

CONFIG = VisionConfig()
ROOT = Path(__file__).parent.parent.parent.parent
WAYPOINTS = {"waypoints": [[1.0, 0.5], [0.0, -1.0]]}


def options_of(name: str) -> dict:
    return WAYPOINTS if name.startswith("goto") else {}


@pytest.mark.parametrize("seed", [7, 19])
@pytest.mark.parametrize("name", REGISTRY.names())
def test_every_mission_keeps_the_contract(name, seed):
    check_mission(mission_spec(name, options_of(name), CONFIG), frames=120, seed=seed)


class Raising:
    """A mission that breaks the contract."""

    Config = mission_spec("band", {}, CONFIG).plugin.Config

    def __init__(self, config, camera):
        self.count = 0

    def step(self, view):
        self.count += 1
        return Plan(STILL, "fine" if self.count < 50 else "two\nlines")


class Unscaled(Raising):
    """It claims to read the camera model of each view."""

    scales = True

    def __init__(self, config, camera):
        self.width_px = camera.width_px

    def step(self, view):
        return Plan(STILL, f"{self.width_px} px")


def test_contract_finds_each_broken_promise():
    with pytest.raises(AssertionError, match="one line"):
        check_mission(mission_spec(f"{__name__}:Raising", {}, CONFIG))
    with pytest.raises(AssertionError, match="camera model of each view"):
        check_mission(mission_spec(f"{__name__}:Unscaled", {}, CONFIG))


class Stepless:
    """Written from memory."""

    class Config(Settings):
        """Nothing to set."""


# --- choosing --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "options", "words"), [
    ("folow", {}, "no mission called 'folow'; did you mean 'follow'?"),
    ("os:nothing", {}, "cannot be loaded"),
    ("no_such_package:Name", {}, "cannot be loaded: No module named"),
    ("math:pi", {}, "mission 'math:pi': not a class with a pydantic model called Config"),
    (f"{__name__}:Stepless", {}, "has no method step(): docs/how-to/write-a-mission.md"),
    ("band", {"centre_shere": 0.1}, "unknown option 'centre_shere'; it takes"),
    ("band", {"centre_share": 3}, "option 'centre_share': Input should be less than or equal to 1"),
    ("band", {"centre_share": float("nan")}, "centre_share"),
    ("follow", {"target": {"radius_m": -1}}, "option 'target.radius_m'"),
    ("follow", {"target": 3}, "option 'target'"),
    ("goto", {}, "option 'waypoints' is missing"),
])
def test_invalid_choice_gives_one_line_with_the_reason(kind, options, words):
    with pytest.raises(ConfigError) as error:
        mission_spec(kind, options, CONFIG)
    assert words in str(error.value) and len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("name", ["folow", "zzz", f"{__name__}:Raising", "no_such_package:Name"])
def test_requested_mission_names_no_class_and_none_is_offered(name):
    request = MissionRequest.model_construct(id=1, name=name, options={}, waypoints=())
    with pytest.raises(ConfigError, match=f"^no mission called {name!r}") as error:
        requested_mission(request, CONFIG)
    assert str(error.value).endswith("traffic-light, traffic-light-boxes")


def test_an_entry_point_gives_a_mission_its_name(monkeypatch):
    shy = EntryPoint("shy", "examples.my_mission:Shy", REGISTRY.group)
    broken = EntryPoint("broken", "examples.nothing:There", REGISTRY.group)
    with_entries(monkeypatch, REGISTRY.group, shy, broken)
    monkeypatch.chdir(ROOT)
    assert requested_mission(MissionRequest(id=1, name="shy", options={"near_px": 12}), CONFIG).config.near_px == 12
    with pytest.raises(ConfigError, match="'broken' cannot be loaded"):
        mission_spec("broken", {}, CONFIG)
    with pytest.raises(ConfigError, match="did you mean 'shy'"):
        mission_spec("shi", {}, CONFIG)


def test_a_mission_begins_with_the_sections_of_vision_and_its_options_lie_over_them():
    config = VisionConfig.model_validate({"target": {"stand_off_m": 0.5, "radius_m": 0.07}, "mission": {
        "options": {"target": {"stand_off_m": 1.5}, "steer": {"bearing_kp": 2}}}})
    made = configured_mission(config).config
    assert (made.target.stand_off_m, made.target.radius_m, made.steer.bearing_kp) == (1.5, 0.07, 2.0)
    assert made.track == config.track


def test_stand_off_beyond_the_range_is_rejected():
    with pytest.raises(ValidationError, match="stand_off_m of 8 m must be less than max_range_m, 6 m"):
        VisionConfig.model_validate({"target": {"stand_off_m": 8}})
    with pytest.raises(ConfigError, match=r"stand_off_m of 0\.8 m must be less than max_range_m, 0\.8 m"):
        requested_mission(MissionRequest(id=1, name="follow", options={"target.max_range_m": 0.8}), CONFIG)


def test_requested_options_override_the_configured_ones():
    config = VisionConfig.model_validate({"mission": {"kind": "band", "options": {"averaged": 3, "linear_mps": 0.3}}})
    asked = requested_mission(MissionRequest(id=1, name="band", options={"linear_mps": 0.2}), config)
    assert (asked.config.averaged, asked.config.linear_mps) == (3, 0.2)
    assert requested_mission(MissionRequest(id=1, name="follow", options={"steer.bearing_kp": 3}), config
                     ).config.steer.bearing_kp == 3
    assert config.mission.options == {"averaged": 3, "linear_mps": 0.3}
    others = config.model_copy(update={"missions": {"goto": {"sight_m": 2.0, "waypoints": [[9, 9]]}}})
    goto = requested_mission(MissionRequest(id=1, name="goto", waypoints=((1.0, 2.0),)), others)
    assert goto.config.waypoints == ((1.0, 2.0),) and goto.wants_scan and not goto.needs_camera
    assert goto.config.sight_m == 2.0


# --- the legacy laws -------------------------------------------------------------------------------------------------


def ball(x_px: float, radius_px: float) -> Detection:
    box = (x_px - radius_px, 120 - radius_px, x_px + radius_px, 120 + radius_px)
    return Detection(*box, 1.0, "target", Circle(x_px, 120.0, radius_px))


def view(*detections: Detection, t_us: int = 1_000_000, camera: CameraModel = CAMERA) -> View:
    return View(FrameHeader(session="0000abcd", seq=1, t_us=t_us), 0.033, 0.06, camera, detections)


def twist_of(mission, *seen: View) -> tuple[float, float]:
    for one in seen:
        plan = mission.step(one)
    return plan.twist.linear_mps, plan.twist.angular_rad_s


def mission(name: str, **options):
    return mission_spec(name, options, CONFIG).build(CAMERA)


@pytest.mark.parametrize(("x_px", "radius_px", "linear_angular"), [
    (159, 15.9, (0.0, 0.0)),  # below 5 % of 320
    (159, 16, (0.1, 0.0)),
    (159, 106.6, (0.1, 0.0)),
    (159, 106.7, (0.0, 0.0)),  # above a third
    (255, 40, (0.1, 0.0)),  # 96 pixels: 30 % of the width, not of half of it
    (256, 40, (0.1, -0.5)),  # the target is right: turn right
    (62, 40, (0.1, 0.5)),
    (63, 40, (0.1, 0.0)),
])
def test_band_steering_has_the_legacy_bands(x_px, radius_px, linear_angular):
    assert twist_of(mission("band"), view(ball(x_px, radius_px))) == linear_angular


def test_band_steering_averages_five_positions_and_takes_the_largest_target():
    law = mission("band")
    for _ in range(4):
        law.step(view(ball(60, 40)))
    assert twist_of(law, view(ball(160, 40), ball(300, 20))) == (0.1, 0.0)  # mean 80: 79 left of the middle, forward
    for _ in range(4):
        law.step(view(ball(260, 40)))
    assert twist_of(law, view(ball(300, 40))) == (0.1, -0.5)
    assert twist_of(law, view()) == (0.0, 0.0)


def test_pixel_pi_has_the_legacy_numbers():
    law = mission("pixel-pi")
    radius = math.sqrt(400 / math.pi)
    linear, angular = twist_of(law, view(ball(200, radius)))
    assert (linear, angular) == (pytest.approx(0.5), pytest.approx(-0.2 * 1.007))
    linear, angular = twist_of(law, view(ball(200, radius)))
    assert angular == pytest.approx(-0.2 - 0.007 * 0.4), "the sum grows with each picture, whatever its time"
    assert twist_of(law, view(ball(180, radius)))[1] == 0.0, "0.1 is within the dead band"
    assert twist_of(law, view(ball(181, radius)))[1] == pytest.approx(-0.105 - 0.007 * 0.605)
    assert twist_of(law, view(ball(200, math.sqrt(40 / math.pi) - 1e-9))) == (0.0, 0.0)
    assert twist_of(law, view(ball(160, math.sqrt(41 / math.pi))))[0] == pytest.approx(200 / 41), "as fast as requested"
    assert twist_of(law, view()) == (0.0, 0.0)


def test_pixel_pi_can_be_bounded():
    law = mission("pixel-pi", max_linear_mps=0.4, stop_area_px=1800, max_integral_rad_s=1)
    for _ in range(100):
        linear, angular = twist_of(law, view(ball(300, 10)))
    assert linear == 0.4 and angular == pytest.approx(-0.7 - 0.007)
    assert twist_of(law, view(ball(300, 30)))[0] == 0.0


@pytest.mark.parametrize(("x_px", "radius_px", "linear_angular"), [
    (160, 10, (0.0, 0.0)),  # no larger than ten pixels: none
    (160, 11, (0.5, 0.0)),
    (141, 30, (0.5, 0.009 * 19)),
    (140, 30, (0.2, 0.009 * 20)),
    (250, 30, (0.2, -0.009 * 90)),
    (140, 50, (0.2, 0.009 * 20)),
    (140, 51, (0.0, 0.009 * 20)),
])
def test_pixel_p_has_the_legacy_numbers(x_px, radius_px, linear_angular):
    assert twist_of(mission("pixel-p"), view(ball(x_px, radius_px))) == pytest.approx(linear_angular)


def test_pixel_p_decides_five_times_a_second():
    law = mission("pixel-p")
    turns = [twist_of(law, view(ball(160 + at, 30), t_us=10_000_000 + at * 33_333))[1] for at in range(12)]
    assert [round(turn / -0.009) for turn in turns] == [0] * 7 + [7] * 5
    assert twist_of(law, view(t_us=12_000_000)) == (0.0, 0.0)


FAR = st.floats(allow_nan=False, allow_infinity=False)
SIZE = st.floats(min_value=0, exclude_min=True, allow_infinity=False)


@example(box=(1e308, 0.0, 1.7e308, 1e308), circle=None, size=1.0)
@example(box=(1e-320, 0.0, 2e-320, 1.0), circle=None, size=1.0)
@example(box=(0.0, 0.0, 1.0, 1.0), circle=1e308, size=1e308)
@example(box=(0.0, 0.0, 0.0, 0.0), circle=0.0, size=1.0)
@given(box=st.tuples(FAR, FAR, FAR, FAR), circle=st.none() | FAR, size=SIZE)
def test_legacy_controllers_give_a_twist_for_any_box(box, circle, size):
    one = Detection(*box, 0.9, "ball", None if circle is None else Circle(circle, 0.0, size))
    for kind in ("band", "pixel-p", "pixel-pi"):
        law = mission(kind, **({"min_area_px": 0} if kind == "pixel-pi" else {}))
        assert all(abs(speed) < 1e9 for _ in range(2) for speed in twist_of(law, view(one)))


# --- the page --------------------------------------------------------------------------------------------------------

PAGE, WRITE, LEGACY = ((ROOT / "docs" / page).read_text("utf-8") for page in (
    "how-to/missions.md", "how-to/write-a-mission.md", "explanation/legacy-controllers.md"))


def test_the_page_names_every_mission_and_shows_its_example_as_it_is(monkeypatch):
    table = PAGE.partition("## 2. Start with it")[0]
    assert set(re.findall(r"`([a-z-]+)`", table)) >= set(REGISTRY.names())
    shown = re.search(r"```python\n(class Shy:.*?)```", WRITE, re.DOTALL)[1]
    assert shown.strip() in (ROOT / "examples" / "my_mission.py").read_text("utf-8") and shown.count("\n") <= 30
    monkeypatch.chdir(ROOT)
    check_mission(mission_spec("examples.my_mission:Shy", {"near_px": 30}, CONFIG))
    law = mission_spec("examples.my_mission:Shy", {}, CONFIG).build(CAMERA)
    assert twist_of(law, view(ball(200, 50)))[0] == -0.15 and twist_of(law, view(ball(100, 10)))[1] > 0


def test_the_sane_numbers_of_the_page_are_options_of_their_missions():
    laws = re.findall(r"```toml\n(.*?)```", LEGACY, re.DOTALL)
    blocks = [tomllib.loads(text)["mission"] for text in laws]
    assert [one["kind"] for one in blocks] == ["band", "pixel-pi", "pixel-p"]
    for one in blocks:
        chosen = mission_spec(one["kind"], one["options"], CONFIG)
        assert chosen.config != chosen.plugin.Config()
