"""The table of device groups: each row stands in the configuration, pyproject.toml and docs/reference/configuration.md.

`python -m tests.robot_side.test_plugins` writes the page's table.
"""

import array
import inspect
import math
import re
import tomllib
from asyncio import CancelledError
from dataclasses import replace
from pathlib import Path

import pytest

from sightline.protocol.config import Config, PluginRegistry
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.plugins import BATTERIES, DEVICE_GROUPS, DRIVES
from sightline.robot_side.ports import Ranges, check_scan

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
    demanded = {*group.methods, "close", *(["zero"] if group is DRIVES else [])}
    assert demanded > {"close"}
    for kind in ENTRY_POINTS[group.entry_points]:
        plugin = PluginRegistry(group.key, group.entry_points).load(kind)
        assert [name for name in sorted(demanded) if not callable(getattr(plugin, name, None))] == [], kind


@pytest.mark.parametrize("group", DEVICE_GROUPS, ids=lambda group: group.key)
def test_error_of_an_unknown_kind_names_each_kind_that_the_configuration_takes(group):
    switched_off = RobotConfig.model_validate({group.key: {"kind": "none"}}).devices[group.key] is None
    with pytest.raises(ConfigError) as error:
        group.load(PluginChoice(kind="nona"))
    named = str(error.value).partition("there are ")[2].replace(",", "").split()
    assert {*ENTRY_POINTS[group.entry_points], *(["none"] if switched_off else [])} <= set(named)
    assert ("none" in named) == switched_off


ERRORS = {
    "": ValueError("no\n\x1bport"), "exit": SystemExit(0), "cancel": CancelledError("gone"), "end": GeneratorExit(),
    "interrupt": KeyboardInterrupt(),
}


class OddDevice:
    """Raises as configured."""

    class Config(Config):
        raises: str = ""

    def __init__(self, config):
        if config.raises != "nothing":
            raise ERRORS[config.raises]

    def __getattr__(self, name):
        if name == "read":
            return lambda: 12.0
        raise AttributeError(name)


TEXTS = [("", "ValueError: no ?port"), ("exit", "SystemExit: 0"), ("cancel", "CancelledError: gone"),
         ("end", "GeneratorExit: GeneratorExit")]


@pytest.mark.parametrize(("raises", "text", "is_last"), [
    *((*row, is_last) for row in TEXTS for is_last in (True, False)),
    ("interrupt", "KeyboardInterrupt: KeyboardInterrupt", False),
])  # fmt: skip
def test_exception_of_a_device_at_its_start_is_one_line_that_names_it(caplog, raises, text, is_last):
    choice = PluginChoice(kind=f"{__name__}:OddDevice", options={"raises": raises})
    with pytest.raises(HardwareError) as caught:
        BATTERIES.build(choice, is_last=is_last)
    assert str(caught.value) == f"battery '{choice.kind}' raised {text}"
    assert len(caplog.records) == is_last


def test_interrupt_while_a_device_opens_ends_the_program_with_a_line_that_names_it(caplog):
    kind = f"{__name__}:OddDevice"
    with pytest.raises(KeyboardInterrupt):
        BATTERIES.build(PluginChoice(kind=kind, options={"raises": "interrupt"}))
    assert caplog.messages == [f"interrupted while the battery {kind} opened"]


def test_device_without_a_method_of_its_port_is_rejected_and_may_have_it_in_any_way():
    choice = PluginChoice(kind=f"{__name__}:OddDevice", options={"raises": "nothing"})
    assert BATTERIES.build(choice).read() == 12.0
    with pytest.raises(ConfigError, match=rf"^drive '{choice.kind}' has no method set\(\): docs/how-to"):
        DRIVES.build(choice)


SCAN = Ranges(1, 0.0, 0.1, 0.05, 8.0, array.array("f", [1.0]))


@pytest.mark.parametrize(("scan", "text"), [
    (None, r"read\(\) returned NoneType"), (replace(SCAN, t_us=1.5), "Ranges.t_us is float"),
    (replace(SCAN, t_us=-1), "Ranges.t_us is -1; take the robot's clock"),
    (replace(SCAN, t_us=2**53), "Ranges.t_us is 9007199254740992; take"),
    (replace(SCAN, range_max_m=math.nan), "Ranges.range_max_m is nan"),
    (replace(SCAN, angle_min_rad=math.nan), "Ranges.angle_min_rad is nan"),
    (replace(SCAN, ranges_m=array.array("f", [1.0]) * 16_385), "a scan of 16385 rays; at most 16384"),
])
def test_wrong_scan_is_named(scan, text):
    with pytest.raises((TypeError, ValueError), match=text):
        check_scan(scan)
    check_scan(replace(SCAN, ranges_m=array.array("f", [1.0]) * 16_384))
    for t_us in (0, 2**53 - 1):
        check_scan(replace(SCAN, t_us=t_us))


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
