"""The table of device groups: each row stands in the configuration, pyproject.toml and docs/reference/configuration.md.

`python -m tests.robot_side.test_plugins` writes the page's table.
"""

import inspect
import re
import tomllib
from pathlib import Path

import pytest

from sightline.protocol.config import PluginRegistry
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.plugins import DEVICE_GROUPS

ROOT = Path(__file__).parent.parent.parent
ENTRY_POINTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
PAGE = ROOT / "docs" / "reference" / "configuration.md"
MARKS = re.compile(r"(<!-- generated: devices[^\n]*-->\n).*?(<!-- /generated -->)", re.DOTALL)
OF_DETECTION = {"sightline.detectors", "sightline.missions"}


def test_the_table_the_configuration_and_the_entry_points_name_the_same_groups():
    keys = [group.key for group in DEVICE_GROUPS]
    assert list(RobotConfig().devices) == keys, "RobotConfig.devices"
    assert [key for key in keys if key not in RobotConfig.model_fields] == [], "RobotConfig"
    assert {group.entry_points for group in DEVICE_GROUPS} == set(ENTRY_POINTS) - OF_DETECTION, "pyproject.toml"


@pytest.mark.parametrize("group", DEVICE_GROUPS, ids=lambda group: group.key)
def test_each_built_in_device_implements_its_port(group):
    demanded = {name for name, value in vars(group.port).items() if callable(value) and not name.startswith("_")}
    assert demanded >= {"close"}
    for kind in ENTRY_POINTS[group.entry_points]:
        plugin = PluginRegistry(group.key, group.entry_points).load(kind)
        assert [name for name in sorted(demanded) if not callable(getattr(plugin, name, None))] == [], kind


def page_with_table(text: str) -> str:
    """The page with the table of now: one row per kind of device."""
    rows = ["| key | what it is | entry points | comes with Sightline |", "|---" * 4 + "|"]
    for group in DEVICE_GROUPS:
        about = inspect.getdoc(group.port).splitlines()[0]
        kinds = ", ".join(f"`{kind}`" for kind in ENTRY_POINTS[group.entry_points])
        rows.append(f"| `{group.key}` | {about} | `{group.entry_points}` | {kinds} |")
    return MARKS.sub(lambda marks: marks[1] + "\n".join(rows) + "\n" + marks[2], text)


def test_the_page_shows_the_table_of_the_code():
    assert MARKS.search(PAGE.read_text())
    assert page_with_table(PAGE.read_text()) == PAGE.read_text()


if __name__ == "__main__":
    PAGE.write_text(page_with_table(PAGE.read_text()))
