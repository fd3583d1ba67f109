"""Fixtures of the WebSocket tests."""

import pytest

from tests.fixtures.websocket import Robot


@pytest.fixture
def robot():
    """A listening robot with a healthy peer beside the client that misbehaves."""
    listening = Robot()
    yield listening
    listening.close()
