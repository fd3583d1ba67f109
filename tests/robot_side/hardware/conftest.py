"""Fixtures of the tests of the drive on pins. They import gpiozero only where a test uses them."""

import pytest


@pytest.fixture
def board(monkeypatch):
    """A factory of mock pins in gpiozero's own place; `events` is what happened to them, in order."""
    from gpiozero import Device
    from gpiozero.pins.mock import MockFactory

    from tests.fixtures.gpio import NotingPin

    factory = MockFactory(pin_class=NotingPin)
    factory.events = []
    monkeypatch.setattr(Device, "pin_factory", factory)
    return factory


@pytest.fixture
def drive(board):
    """An open drive on the mock pins."""
    from sightline.robot_side.hardware.gpio import GpioDrive
    from tests.fixtures.gpio import config

    opened = GpioDrive(config())
    yield opened
    opened.close()
