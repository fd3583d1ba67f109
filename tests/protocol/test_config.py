"""Plug-ins by name, and validation errors as one line."""

import sys
from typing import ClassVar

import pytest
from pydantic import Field, ValidationError

from sightline.protocol.config import Config, PluginRegistry, first_problem
from sightline.protocol.errors import ConfigError

CAMERAS = PluginRegistry("camera", "sightline.cameras")


class Mount(Config):
    height_m: float = 0.0


class Lens(Config):
    focal_px: float = Field(gt=0)
    name: str = "lens"
    mount: Mount = Mount()
    range_m: tuple[float, ...] = ()


def problem_of(given, *arguments):
    with pytest.raises(ValidationError) as error:
        Lens.model_validate(given)
    return first_problem(error.value, *arguments)


@pytest.mark.parametrize(("given", "as_option", "plain"), [
    ({}, "option 'focal_px' is missing", "key 'focal_px' is missing"),
    ({"focal": 3}, "unknown option 'focal'; it takes focal_px, name, mount, range_m",
     "unknown key 'focal'; it takes focal_px, name, mount, range_m"),
    ({"focal_px": 3, "name": 3}, "option 'name': expected text", "name: expected text"),
    ({"focal_px": 3, "range_m": 3}, "option 'range_m': expected a list", "range_m: expected a list"),
    ({"focal_px": 3, "mount": 3}, "option 'mount': expected a table", "mount: expected a table"),
    ({"focal_px": -1}, "option 'focal_px': Input should be greater than 0", "focal_px: Input should be greater than 0"),
])
def test_the_first_problem_is_one_line(given, as_option, plain):
    assert problem_of(given, "option", Lens.model_fields) == as_option
    assert problem_of(given, "", Lens.model_fields) == plain


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


@pytest.mark.parametrize(("line", "new"), [
    ("from robot_side.ports import Picture", "robot_side.ports is now sightline.robot_side.ports"),
    ("import vision_side.detect.port", "vision_side.detect.port is now sightline.vision_side.detect.port"),
    ("from protocol.messages import Twist", "protocol.messages is now sightline.protocol.messages"),
    ("from protocol import messages", "protocol is now sightline.protocol"),
])
def test_a_plug_in_that_imports_an_old_module_gets_its_new_path(folder, line, new):
    name = f"old_{abs(hash(line))}"
    (folder / f"{name}.py").write_text(f"{line}\n\n\nclass Camera:\n    pass\n")
    with pytest.raises(ConfigError) as error:
        CAMERAS.load(f"{name}:Camera")
    assert str(error.value) == f"camera '{name}:Camera' cannot be loaded: {new}; use that name"


def test_a_configuration_that_names_an_old_module_gets_its_new_path(folder):
    with pytest.raises(ConfigError) as error:
        CAMERAS.load("robot_side.hardware.cameras.files:StillCamera")
    assert "robot_side.hardware.cameras.files is now sightline.robot_side.hardware.cameras.files" in str(error.value)
    assert "\n" not in str(error.value)


def test_other_missing_module_is_named(folder):
    (folder / "needs_more.py").write_text("import no_such_module\n")
    with pytest.raises(ConfigError, match="cannot be loaded: No module named 'no_such_module'"):
        CAMERAS.load("needs_more:Camera")


@pytest.mark.parametrize("kind", ["no_such_module:Camera", "no_such_module.inner:Camera"])
def test_class_of_another_folder_is_reported_with_the_folder_that_was_searched(folder, kind):
    with pytest.raises(ConfigError) as error:
        CAMERAS.load(kind)
    assert str(error.value) == (f"camera '{kind}' cannot be loaded: No module named 'no_such_module'; "
                                f"start the command in the folder that has no_such_module, not in {folder}")


def test_plug_in_that_exits_on_import_does_not_end_the_service(folder):
    (folder / "leaves.py").write_text("import sys\nsys.exit('bye\\nnow')\n")
    with pytest.raises(ConfigError, match=r"'leaves:Camera' cannot be loaded: SystemExit: bye now$"):
        CAMERAS.load("leaves:Camera")


class Paint(Config):
    renamed_keys: ClassVar = {"colour": "color"}
    color: str = "red"


def test_renamed_key_is_accepted_with_one_warning(caplog):
    assert [Paint.model_validate({"colour": "blue"}).color for _ in range(3)] == ["blue"] * 3
    assert caplog.messages == ["configuration key 'colour' is now 'color'; rename it"]
    assert Paint.model_validate({"color": "green"}).color == "green" and len(caplog.messages) == 1
