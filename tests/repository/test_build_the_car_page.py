"""The pages build-the-car and teleop: their commands parse, their tables are the code's, their files exist."""

import re
import shlex
import xml.etree.ElementTree
from pathlib import Path

import pytest
import typer

from sightline.operator_side.cli.commands import app
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.teleop.control import LAYOUTS
from sightline.robot_side.hardware.gpio import GpioDriveConfig

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs"
SOURCE = "https://github.com/sightline-robot/sightline/blob/main/"
CAR, TELEOP = ((DOCS / name).read_text() for name in ("tutorials/build-the-car.md", "how-to/teleop.md"))


def commands(page):
    """The arguments of every `sightline ...` line in a block."""
    for block in re.findall(r"^```(?:console|sh)\n(.*?)^```", page, re.DOTALL | re.MULTILINE):
        for line in block.splitlines():
            words = shlex.split(re.sub(r"^(car|laptop)\$ (sudo )?", "", line))
            if words[:1] == ["sightline"]:
                yield words[1:]


@pytest.mark.parametrize("words", [*commands(CAR), *commands(TELEOP)], ids=" ".join)
def test_every_command_is_one(words):
    """Parsed by the program's own parser, and not run."""
    command, context = typer.main.get_command(app), None
    while hasattr(command, "commands"):
        name, *words = words
        command = command.commands[name]
    context = command.make_context("sightline", list(words))
    assert context.params


def test_the_wiring_is_the_configurations_own():
    rows = re.findall(r"^\| GPIO (\d+) \| (\d+) \| .* \| (left|right) (forward|backward) \|", CAR, re.MULTILINE)
    assert len(rows) == 4
    defaults = GpioDriveConfig.model_fields
    assert {f"{side}_{way}_pin": int(number) for number, _, side, way in rows} == {
        name: defaults[name].default for name in defaults if name.endswith("ward_pin")
    }
    positions = {10: 19, 9: 21, 8: 24, 7: 26}
    assert {int(number): int(position) for number, position, _, _ in rows} == positions
    drawn = "".join(xml.etree.ElementTree.parse(DOCS / "assets" / "car-wiring.svg").getroot().itertext())
    for number, position in {**positions, 17: 11}.items():
        assert f"GPIO {number} ({position})" in drawn


def test_page_names_every_option_of_the_drive():
    table = CAR[CAR.index("| `drive.options` |") : CAR.index("The drive interpolates")]
    named = set(re.findall(r"`([a-z_]+)`", " ".join(row.split("|")[1] for row in table.splitlines() if row)))
    own = {name for name in GpioDriveConfig.model_fields if not name.endswith("ward_pin")} - {"wheel_radius_m"}
    assert named - {"left_forward_pin", "right_backward_pin"} == own


def test_vision_example_has_the_cars_own_limits():
    """The gate cuts requests beyond these limits, but the vision service steers better if it knows them."""
    car, eyes = (load_service(service, file=str(ROOT / "examples" / name), environ={}).config for service, name in (
        ("robot", "raspberry-car.toml"), ("vision", "raspberry-car-vision.toml")))
    assert eyes.steer.max_linear_mps == car.safety.max_linear_mps
    assert eyes.steer.max_angular_rad_s == car.safety.max_angular_rad_s >= eyes.search.rate_rad_s
    assert eyes.latency.linear_acceleration_mps2 == car.safety.max_acceleration_mps2


def test_the_files_that_they_name_exist():
    for folder, page in (("tutorials", CAR), ("how-to", TELEOP)):
        for name in re.findall(r"\]\(([^)#]+)\)", page):
            target = ROOT / name.removeprefix(SOURCE) if name.startswith(SOURCE) else DOCS / folder / name
            assert target.resolve().exists(), name
        for name in re.findall(r"tests/test_\w+\.py|robot_side/systemd/[\w.-]+|examples/[\w.-]+", page):
            assert (ROOT / name).exists(), name


def test_the_keys_are_those_that_teleop_shows():
    for layout in LAYOUTS.values():
        assert layout.help in TELEOP
