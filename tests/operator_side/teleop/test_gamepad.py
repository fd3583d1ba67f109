"""The gamepad's shell: the device that it takes, its events, and its errors when the device is missing or goes."""

import errno
import sys
from types import SimpleNamespace

import pytest

from sightline.operator_side.teleop.gamepad import (
    ABS_RX,
    ABS_X,
    ABS_Y,
    BTN_EAST,
    BTN_SOUTH,
    BTN_TL,
    BTN_TR,
    EV_ABS,
    EV_KEY,
    EV_SYN,
    SYN_DROPPED,
    SYN_REPORT,
    Gamepad,
    Pad,
    PadKey,
)
from sightline.protocol.errors import ConfigError, HardwareError


class Device:
    """The used part of `evdev.InputDevice`; it gives `events` once, then it is gone."""

    def __init__(self, path, keys=(BTN_SOUTH, BTN_TL), axes=(ABS_X, ABS_Y), value=128):
        self.path, self.name, self.fd = path, f"pad {path}", 7
        self.closed, self.events, self.pressed = False, [], []
        self._keys, self._axes = list(keys), [(code, SimpleNamespace(min=0, max=255, value=value)) for code in axes]

    def capabilities(self, absinfo=False):
        return {EV_KEY: self._keys, EV_ABS: self._axes if absinfo else [code for code, _ in self._axes]}

    def read(self):
        if self.events is None:
            raise OSError(errno.ENODEV, "No such device")
        if not self.events:
            raise BlockingIOError
        events, self.events = self.events, None
        return [SimpleNamespace(type=kind, code=code, value=value) for kind, code, value in events]

    def active_keys(self):
        return self.pressed

    def absinfo(self, code):
        return dict(self._axes)[code]

    def move(self, code, value):
        self.absinfo(code).value = value

    def close(self):
        self.closed = True


REASONS = {
    "/dev/input/event99": (errno.ENOENT, "No such file or directory"),
    "/dev/null": (errno.ENOTTY, "Inappropriate ioctl for device"),
}


@pytest.fixture
def plugged(monkeypatch):
    """Plug devices in by path."""
    devices = {}

    def opened(path):
        if path not in devices:
            raise OSError(*REASONS.get(path, (errno.EACCES, "Permission denied")))
        return devices[path]

    monkeypatch.setitem(sys.modules, "evdev", SimpleNamespace(InputDevice=opened, list_devices=lambda: list(devices)))
    return devices


def test_auto_opens_the_first_gamepad_and_closes_the_others(plugged):
    plugged["/dev/input/event1"] = mouse = Device("/dev/input/event1", keys=(), axes=())
    plugged["/dev/input/event2"] = Device("/dev/input/event2")
    assert Gamepad("auto").name == "pad /dev/input/event2"
    assert mouse.closed


def test_gamepad_events_are_read_and_its_end_is_an_error(plugged):
    plugged["a"] = device = Device("a")
    gamepad = Gamepad("a")
    assert gamepad.read() == [] and gamepad.fileno() == 7
    device.events = [(EV_KEY, BTN_TL, 1), (EV_ABS, ABS_Y, 0), (EV_KEY, BTN_EAST, 0), (EV_KEY, BTN_EAST, 1)]
    assert gamepad.read() == [PadKey.STOP] and gamepad.pad.shares is None
    with pytest.raises(HardwareError, match="gamepad pad a: No such device; the robot stops"):
        gamepad.read()


@pytest.mark.parametrize(("path", "says"), [
    ("auto", "no gamepad found"), ("/dev/input/event9", "Permission denied; add your user to the group input"),
    ("/dev/input/event99", "gamepad /dev/input/event99: No such file or directory; connect it, or take the first"),
    ("/dev/null", "gamepad /dev/null: Inappropriate ioctl for device; connect it, or take the first gamepad with"),
    ("keys", "has no stick; name a gamepad"),
])  # fmt: skip
def test_missing_gamepad_is_one_line(plugged, path, says):
    plugged["keys"] = Device("keys", keys=(), axes=(ABS_X,))
    with pytest.raises(HardwareError, match=says):
        Gamepad(path)


def test_missing_evdev_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(ConfigError, match=r"evdev is not installed: pip install --editable '\.\[gamepad\]'"):
        Gamepad("auto")


LOST = [(EV_SYN, SYN_DROPPED, 0), (EV_KEY, BTN_TL, 1), (EV_ABS, ABS_Y, 128)]
"""Lost events, and the rest of their packet."""
END = (EV_SYN, SYN_REPORT, 0)


def test_after_events_were_lost_nothing_counts_as_held():
    """The release may have been among them; only a new press drives."""
    pad = Pad({ABS_Y: (0, 255)})
    pad.on_event(EV_KEY, BTN_TL, 1)
    pad.on_event(EV_ABS, ABS_Y, 0)
    assert pad.shares == (1.0, 0.0)
    for event in (*LOST, (EV_KEY, BTN_TL, 1)):
        pad.on_event(*event)
        assert pad.shares is None
    pad.on_state({ABS_Y: 10}, [BTN_TL])
    assert pad.shares is None
    pad.on_event(EV_KEY, BTN_TL, 1)
    assert pad.shares is not None


@pytest.mark.parametrize("later", [[], [(EV_KEY, BTN_TL, 1), END]], ids=["alone", "with older events"])
@pytest.mark.parametrize("axis", [ABS_X, ABS_Y])
@pytest.mark.parametrize(("before", "now"), [(128, 0), (0, 128)], ids=["pushed", "released"])
def test_after_lost_events_the_sticks_are_where_the_device_reports_them(plugged, axis, before, now, later):
    plugged["a"] = device = Device("a")
    gamepad = Gamepad("a")
    device.events = [(EV_KEY, BTN_TL, 1), (EV_ABS, axis, before), END]
    gamepad.read()
    device.move(axis, now)
    device.events = [*LOST, (EV_ABS, axis, before), END, *later]
    gamepad.read()
    assert gamepad.pad.shares is None
    device.events = [(EV_KEY, BTN_TL, 1), (EV_ABS, ABS_X, 0), (EV_ABS, ABS_Y, 0), END]
    gamepad.read()
    assert gamepad.pad.shares == ((0.0, 0.0) if now == 0 else (1.0, 1.0)), "a pushed stick waits for its center"


def test_state_is_read_at_the_end_of_the_packet_with_lost_events(plugged):
    plugged["a"] = device = Device("a")
    gamepad = Gamepad("a")
    device.pressed = [BTN_EAST]
    for part in LOST:
        device.events = [part]
        assert gamepad.read() == [] and gamepad.pad.is_lost
    device.events = [END]
    assert gamepad.read() == [PadKey.STOP] and not gamepad.pad.is_lost
    device.events = [END]
    assert gamepad.read() == [], "the state is read once"


def test_stop_acts_also_among_lost_events_and_other_buttons_do_not(plugged):
    plugged["a"] = device = Device("a")
    gamepad = Gamepad("a")
    device.events = [*LOST, *((EV_KEY, key, value) for key in (BTN_EAST, BTN_SOUTH) for value in (1, 0)), END]
    assert gamepad.read() == [PadKey.STOP]


def test_trigger_at_rest_does_not_count_after_lost_events_and_a_moved_stick_does(plugged):
    plugged["a"] = device = Device("a", axes=(ABS_X, ABS_Y, ABS_RX))
    gamepad = Gamepad("a")
    press = [(EV_KEY, BTN_TL, 1), (EV_ABS, ABS_Y, 128), (EV_ABS, ABS_Y, 0), END]
    device.move(ABS_RX, 0)
    for event, shares in ((END, (1.0, 0.0)), ((EV_ABS, ABS_RX, 128), (0.0, 0.0))):
        device.events = [event, *LOST, END]
        gamepad.read()
        device.events = press
        gamepad.read()
        assert gamepad.pad.shares == shares


def test_gamepad_that_goes_while_its_state_is_read_is_an_error(plugged):
    plugged["a"] = device = Device("a")
    gamepad = Gamepad("a")
    device.events = [*LOST, END]
    device.active_keys = device.read  # it is gone
    with pytest.raises(HardwareError, match="gamepad pad a: No such device; the robot stops"):
        gamepad.read()


PUSHED = [(ABS_Y, 0), (ABS_Y, 255), (ABS_X, 0), (ABS_RX, 255), (ABS_RX, 150)]


@pytest.mark.parametrize("axis", PUSHED)
@pytest.mark.parametrize("before", [
    [], [(EV_KEY, BTN_TL, 1), (EV_KEY, BTN_TL, 0)], [(EV_KEY, BTN_TL, 1), (EV_KEY, BTN_EAST, 1), (EV_KEY, BTN_TL, 0)],
    [(EV_KEY, BTN_TL, 1), (EV_SYN, SYN_DROPPED, 0)],
], ids=["first", "again", "after stop", "after lost events"])
def test_stick_that_is_pushed_when_the_button_is_pressed_drives_only_after_it_was_centered(axis, before):
    pad = Pad(dict.fromkeys((ABS_X, ABS_Y, ABS_RX), (0, 255)))
    code, value = axis
    for event in before:
        pad.on_event(*event)
    pad.on_state({})
    for event in ((EV_ABS, code, value), (EV_KEY, BTN_TL, 1)):
        pad.on_event(*event)
    assert pad.shares == (0.0, 0.0)
    pad.on_event(EV_ABS, code, value + (1 if value < 128 else -1))  # it jitters
    pad.on_event(EV_KEY, BTN_TR, 1)
    assert pad.shares == (0.0, 0.0)
    pad.on_event(EV_ABS, code, 128)
    pad.on_event(EV_ABS, code, value)
    assert pad.shares is not None and any(pad.shares)
    pad.on_event(EV_KEY, BTN_TL, 0)
    assert any(pad.shares), "the other shoulder button is still held"


def test_other_stick_that_is_pushed_waits_too():
    pad = Pad(dict.fromkeys((ABS_X, ABS_Y, ABS_RX), (0, 255)))
    for event in ((EV_ABS, ABS_RX, 255), (EV_KEY, BTN_TL, 1), (EV_ABS, ABS_Y, 0)):
        pad.on_event(*event)
    assert pad.shares == (0.0, 0.0)
    pad.on_event(EV_ABS, ABS_RX, 128)
    assert pad.shares == (0.0, 0.0), "the first stick is pushed meanwhile"
    pad.on_event(EV_ABS, ABS_Y, 128)
    pad.on_event(EV_ABS, ABS_Y, 0)
    assert pad.shares == (1.0, 0.0)


def test_stick_that_was_pushed_before_teleop_started_drives_only_after_it_was_centered(plugged):
    plugged["a"] = device = Device("a", value=0)
    gamepad = Gamepad("a")
    device.events = [(EV_KEY, BTN_TL, 1), (EV_ABS, ABS_Y, 3)]
    gamepad.read()
    assert gamepad.pad.shares == (0.0, 0.0)
    plugged["b"] = device = Device("b", axes=(ABS_X, ABS_Y, ABS_RX))
    device._axes[2][1].value = 0  # a trigger at rest
    gamepad = Gamepad("b")
    device.events = [(EV_KEY, BTN_TL, 1), (EV_ABS, ABS_Y, 0)]
    gamepad.read()
    assert gamepad.pad.shares == (1.0, 0.0)
