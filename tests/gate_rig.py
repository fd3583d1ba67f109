"""A gate brought to each of its states over the way a robot gets there, and a guest that drives it."""

import pytest

from sightline.protocol.errors import WireError
from sightline.protocol.messages import Holder, State, Twist, Verb
from tests.fixtures.safety import HUMAN, VISION, Rig

VISION_HOLDER, HUMAN_HOLDER = Holder(source="vision", session=VISION), Holder(source="teleop", session=HUMAN)
GUEST = Holder(source="guest", session="00000000")
D, H, A, G, S, F = (
    State.DISARMED, State.HOLD, State.ACTIVE, State.DEGRADED, State.STOPPED, State.FAULT,
)  # fmt: skip


def refused(rig, verb, **kwargs):
    with pytest.raises(WireError) as caught:
        rig.request(verb, **kwargs)
    return caught.value


def twist(linear_mps, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def driving(state=A, **config):
    """A rig brought to `state` over the way a robot gets there."""
    rig = Rig(**config)
    if state in (H, A, G):
        rig.armed()
    if state is A:
        rig.drive(20)
    if state is G:
        rig.drive(20, age_ms=200)
    if state is S:
        rig.gate.stop("STOP by test")
    if state is F:
        rig.gate.fault("broken")
    assert rig.gate.state is state
    return rig


def guest(rig, linear=9.0, angular=0.0):
    return rig.gate.offer("guest", None, twist(linear, angular), rig.now_us)


def guest_driving(ms=600, linear=9.0, angular=0.0, **config):
    rig = Rig(guests=True, **config)
    for _ in range(5):
        guest(rig)
        rig.step()
    rig.request(Verb.ARM)
    for _ in range(ms // 20):
        guest(rig, linear, angular)
        rig.step()
    return rig
