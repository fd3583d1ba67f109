"""The source of the pins and their state afterwards: gpiozero, lgpio, and machines without both."""

import json
import os
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.fixtures import demanded

demanded.module("gpiozero", "robot-pi")
from gpiozero import Device
from gpiozero.pins.mock import MockFactory

from sightline.operator_side.config.loading import load_service
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.robot_side.hardware import gpio as gpio_pins
from sightline.robot_side.hardware import gpio_low
from sightline.robot_side.hardware.gpio import GpioDrive
from sightline.robot_side.plugins import DRIVES
from tests.fixtures.gpio import FakeLgpio, NotingPin, config

ROOT = Path(__file__).parent.parent.parent.parent
MEMORY_KB = 15_000
GUARDIAN = """
import json, os, sys
root, sys.path[:] = sys.argv.pop(), json.loads(sys.argv.pop())
top = type(sys)('sightline'); top.__path__ = [root]; sys.modules['sightline'] = top
import sightline.robot_side.guardian.process
from sightline.robot_side.hardware import gpio_low
made = []
sys.addaudithook(lambda event, given: event == "os.mkdir" and made.append(given[0]))
gpio_low.prepare()
print(os.getcwd(), len(made), *map(os.path.exists, made), os.environ.get("LG_WD"), sys.modules["lgpio"].__name__)
print(*open("/proc/self/status"))
"""
"""What the guardian of a gpio robot imports, as `robot_side/guardian/start.py` starts it."""


@pytest.mark.parametrize("module", ["gpiozero", "lgpio"])
def test_a_missing_package_names_its_extra(monkeypatch, module):
    monkeypatch.setattr(Device, "pin_factory", None)
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "gpiozero.pins.lgpio", raising=False)
    with pytest.raises(ConfigError, match=rf"needs {module}: pip install --editable '\.\[robot-pi\]'"):
        GpioDrive(config())


def test_machine_without_pins_gives_one_error_line(monkeypatch):
    monkeypatch.setattr(Device, "pin_factory", None)
    fake = SimpleNamespace(LGPIOFactory=lambda: 1 / 0)
    monkeypatch.setitem(sys.modules, "gpiozero.pins.lgpio", fake)
    monkeypatch.setitem(sys.modules, "lgpio", SimpleNamespace())
    with pytest.raises(HardwareError, match="no GPIO here: division by zero; this drive needs a Raspberry Pi") as error:
        GpioDrive(config())
    command = shlex.split(str(error.value).split("`")[1])  # it must work with the configuration of the car
    car = load_service("robot", file=str(ROOT / "examples/raspberry-car.toml"), environ={}, sets=command[1::2]).config
    DRIVES.build(car.motors).close()


def test_pins_of_another_process_are_reported(board, drive):
    with pytest.raises(HardwareError, match="already in use"):
        GpioDrive(config())
    assert board.pin("GPIO10").function == "output", "the first one still has it"


def test_spi_that_is_switched_on_is_warned_of(board, monkeypatch, caplog, tmp_path):
    monkeypatch.setattr(gpio_pins, "_SPI_DEVICE", tmp_path)
    GpioDrive(config()).close()
    assert "pins 7, 8, 9, 10 are SPI0's" in caplog.text
    caplog.clear()
    GpioDrive(config(left_forward_pin=17, left_backward_pin=27, right_forward_pin=22, right_backward_pin=23)).close()
    assert caplog.text == ""


def test_pins_are_left_low_by_lgpio_alone(monkeypatch, capsys):
    lgpio = FakeLgpio()
    monkeypatch.setitem(sys.modules, "lgpio", lgpio)
    assert gpio_low.main(["10", "9"]) == 0
    assert lgpio.calls == [("close", 0), (4, 10, 0, 64), (4, 9, 0, 64), ("close", 4)]
    lgpio = FakeLgpio(busy=(10,))
    monkeypatch.setitem(sys.modules, "lgpio", lgpio)
    assert gpio_low.main(["10", "9", "8"]) == 3
    assert [call[1] for call in lgpio.calls if call[0] == 4] == [9, 8], "one that is busy does not keep the others up"
    assert capsys.readouterr().err == "error: pins 10, 9, 8: GPIO busy\n"
    for wrong in ([], ["ten"], ["28"], ["-1"], ["¹"]):
        assert gpio_low.main(wrong) == 2


def test_zero_sets_the_enable_pins_low_first_and_reports_a_pin_that_has_an_owner(monkeypatch):
    lgpio, plain = FakeLgpio(), config(enable_pins=(17,)).model_dump(mode="json")
    monkeypatch.setitem(sys.modules, "lgpio", lgpio)
    GpioDrive.zero(plain)
    assert [call[1] for call in lgpio.calls if call[0] == 4] == [17, 10, 9, 8, 7]
    monkeypatch.setitem(sys.modules, "lgpio", FakeLgpio(busy=(10,)))
    with pytest.raises(OSError, match="GPIO busy"):
        GpioDrive.zero(plain)


def test_zero_needs_its_library_before_its_moment(monkeypatch):
    imported = []
    monkeypatch.setattr(gpio_low, "import_lgpio", lambda: imported.append(1))
    gpio_low.prepare()
    assert imported == [1] and zero_module(GpioDrive) is gpio_low


def test_guardian_of_a_gpio_robot_is_small_and_lgpio_leaves_no_trace(tmp_path):
    if find_spec("lgpio") is None:
        demanded.do_without("lgpio", "no lgpio; run: pip install -e '.[robot-pi]'")
    command = [sys.executable, "-I", "-S", "-c", GUARDIAN, json.dumps(sys.path), str(ROOT)]
    # A checkout compiles its modules at the first start (2 MB more, once); pip does when it installs.
    subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
    printed = subprocess.run(command, check=True, capture_output=True, text=True, cwd=tmp_path).stdout
    assert printed.startswith(f"{tmp_path} 1 False None lgpio\n")
    assert list(tmp_path.iterdir()) == []
    assert int(printed.partition("VmRSS:")[2].split()[0]) <= MEMORY_KB


def zero_module(plugin):
    """Return the module that the guardian imports for a drive."""
    return sys.modules[plugin.zero.__module__]


def test_the_end_of_a_real_factory_leaves_the_pins_pulled_down(monkeypatch):
    """With our own factory (not one that a test put there) its chip is closed and the pins are left by lgpio."""
    factory, lgpio = MockFactory(pin_class=NotingPin), FakeLgpio()
    factory.chip = 0
    monkeypatch.setattr(Device, "pin_factory", None)
    monkeypatch.setitem(sys.modules, "gpiozero.pins.lgpio", SimpleNamespace(LGPIOFactory=lambda: factory))
    monkeypatch.setitem(sys.modules, "lgpio", lgpio)
    GpioDrive(config(enable_pins=(17,))).close()
    assert lgpio.calls == [(0, number, 0, 64) for number in (17, 10, 9, 8, 7)] + [("close", 0)]
    assert Device.pin_factory is None


def test_lgpio_import_leaves_no_pipe_and_keeps_the_folder(tmp_path):
    """The real one, in a process of its own: in a service's working directory it could not even be imported."""
    demanded.module("lgpio", "robot-pi")
    code = (
        "import os; from sightline.robot_side.hardware.gpio_low import import_lgpio; import_lgpio();"
        "print(os.getcwd(), os.listdir(), 'LG_WD' in os.environ)"
    )
    path = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    environ = {**os.environ, "PYTHONPATH": path, "TMPDIR": str(tmp_path)}
    here = tmp_path / "here"
    here.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=here, env=environ, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == f"{here} [] False"
    assert list(tmp_path.iterdir()) == [here]


def test_the_drop_in_puts_the_examples_pins_low_first_and_keeps_the_units_own_command():
    systemd = ROOT / "robot_side/systemd"
    lines = [line for line in (systemd / "gpio-low.conf").read_text().splitlines() if line[:1] != "#"]
    own = next(line for line in (systemd / "sightline-robot.service").read_text().splitlines() if "StopPost" in line)
    module, *numbers = lines[2].partition(" -m ")[2].split()
    car = load_service("robot", file=str(ROOT / "examples/raspberry-car.toml"), environ={}).config
    _, options = DRIVES.load(car.motors)
    assert lines[:2] == ["[Service]", "ExecStopPost="] and lines[3] == own
    assert module == gpio_low.__name__ and [int(text) for text in numbers] == [*options.pins, *options.enable_pins]
