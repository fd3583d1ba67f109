"""The table of device groups: each row stands in the configuration, in pyproject.toml and in the documentation."""

import tomllib
from pathlib import Path

import pytest

from sightline.protocol.config import PluginRegistry
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.plugins import DEVICE_GROUPS

ROOT = Path(__file__).parent.parent.parent
ENTRY_POINTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
OF_DETECTION = {"sightline.detectors", "sightline.missions"}


def test_the_table_the_configuration_and_the_entry_points_name_the_same_groups():
    keys = [group.key for group in DEVICE_GROUPS]
    assert list(RobotConfig().devices) == keys, "RobotConfig.devices"
    assert [key for key in keys if key not in RobotConfig.model_fields] == [], "RobotConfig"
    assert {group.entry_points for group in DEVICE_GROUPS} == set(ENTRY_POINTS) - OF_DETECTION, "pyproject.toml"


@pytest.mark.parametrize("group", DEVICE_GROUPS, ids=lambda group: group.key)
def test_each_built_in_device_has_what_its_port_demands_and_the_page_names_its_group(group):
    demanded = {name for name, value in vars(group.port).items() if callable(value) and not name.startswith("_")}
    assert demanded >= {"close"}
    for kind in ENTRY_POINTS[group.entry_points]:
        plugin = PluginRegistry(group.key, group.entry_points).load(kind)
        assert [name for name in sorted(demanded) if not callable(getattr(plugin, name, None))] == [], kind
    assert f"`{group.entry_points}`" in (ROOT / "docs" / "configuration.md").read_text()
