"""The active mission, and the change to another mission while the robot stands. Pure.

A mission can be a third-party plug-in. A mission that raises, or returns an invalid plan, ends, and the robot stops.
"""

import math
from dataclasses import replace
from numbers import Real
from types import UnionType
from typing import Final

from sightline.protocol.config import PLUGIN_ERRORS
from sightline.protocol.log import printable, report_fault
from sightline.protocol.messages import STILL, CameraModel, Twist
from sightline.vision_side.detect.plugin_calls import annotation_problem
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.missions.registry import MissionSpec
from sightline.vision_side.tracking.track import Target

SETTLE_S: Final = 1.0
"""Longest wait until the robot stands. The new mission then starts anyway, because another cause moves the robot."""
STILL_MPS: Final = 0.01
STILL_RAD_S: Final = 0.03
MAX_COMMAND: Final = 1000.0
"""Limit in m/s and rad/s. A larger command is an error of the mission, and might not fit a twist's 64 bytes."""
_FURTHEST_PX: Final = 1e6
"""The limit of any coordinate on the wire."""
_TYPES: Final[dict[str, type | UnionType]] = {
    "twist": Twist, "phase": str, "note": str, "target": Detection | None,
    "bearing_rad": Real | None, "distance_m": Real | None, "track": Target | None,
}  # fmt: skip


class MissionSwitch:
    """Runs the current mission. `step` always answers, even after an error of the mission."""

    def __init__(self, chosen: MissionSpec, camera: CameraModel) -> None:
        self.chosen = chosen
        """The newest mission, also while the robot comes to rest for it."""
        self._switching = False
        self._waited_s = 0.0
        self._begin(camera)

    def switch(self, chosen: MissionSpec) -> None:
        """Let the robot come to rest from the next frame on, then start `chosen`."""
        self.chosen, self._switching, self._waited_s = chosen, True, 0.0

    def set_camera(self, camera: CameraModel, *, is_scaled: bool) -> bool:
        """Start a running mission again if it needs the camera. A mission that has ended stays ended.

        Args:
            camera: the new model.
            is_scaled: True if it is the former model for images of another size.

        Returns:
            True if the mission starts again.
        """
        continues = not self.chosen.needs_camera or (is_scaled and self.chosen.scales)
        if self._over is not None or self._switching or continues:
            return False
        self._begin(camera)
        return True

    def step(self, view: View) -> Plan:
        """Compute the plan for one frame."""
        if self._switching:
            self._waited_s += view.dt_s
            if not self._is_at_rest(view):
                return Plan(STILL, "switching", f"standing still before {self.chosen.name}")
            self._begin(view.camera)
            view = replace(view, dt_s=0.0)  # first frame of the new mission
        if self._over is None:
            return self._checked(view)
        return self._over

    def _is_at_rest(self, view: View) -> bool:
        """Return True if the wheels stand and a command had time to act, or after the longest wait."""
        if self._waited_s >= SETTLE_S:
            return True
        speeds = (view.header.moving, view.header.applied)
        quiet = all(abs(linear) < STILL_MPS and abs(angular) < STILL_RAD_S for linear, angular in speeds)
        return quiet and self._waited_s >= view.latency_s

    def _begin(self, camera: CameraModel) -> None:
        self._switching = False
        self._over: Plan | None = None
        try:
            self._mission = self.chosen.build(camera)
        except PLUGIN_ERRORS as error:
            self._over = _failed(error)

    def _checked(self, view: View) -> Plan:
        try:
            plan = _usable(self._mission.step(view))
        except PLUGIN_ERRORS as error:  # the service continues, the robot stands
            plan = _failed(error)
        if plan.done:
            self._over = plan = replace(plan, twist=STILL, target=None)
        return plan


def _usable(plan: Plan) -> Plan:
    """Convert a plan to types that report and log accept. Raises TypeError or ValueError for an invalid plan."""
    if not isinstance(plan, Plan):  # e.g. None, if `step` lacks its return
        raise TypeError(f"step() returned {type(plan).__name__}, not a Plan")
    for name, kind in _TYPES.items():
        if not isinstance(getattr(plan, name), kind):
            raise TypeError(f"returned a {name} of type {type(getattr(plan, name)).__name__}")
    linear_mps, angular_rad_s = plan.twist.linear_mps, plan.twist.angular_rad_s
    if not (abs(linear_mps) <= MAX_COMMAND and abs(angular_rad_s) <= MAX_COMMAND):  # also for nan
        raise ValueError(f"returned {linear_mps:g} m/s, {angular_rad_s:g} rad/s")
    track = plan.track
    if track and not all(map(math.isfinite, (track.x_m, track.y_m, track.vx_mps, track.vy_mps))):
        raise ValueError("returned a track with a number that is nan or infinite")
    return replace(
        plan, twist=Twist(linear_mps=float(linear_mps), angular_rad_s=float(angular_rad_s)),
        phase=_line(plan.phase), note=_line(plan.note), done=bool(plan.done), target=_usable_target(plan.target),
        bearing_rad=_float(plan.bearing_rad), distance_m=_float(plan.distance_m),
    )  # fmt: skip


def _line(text: str) -> str:
    return printable(" ".join(text.split()))


def _float(number: float | None) -> float | None:
    """Convert any real number, e.g. of NumPy, to a float for the wire."""
    return None if number is None else float(number)


def _usable_target(one: Detection | None) -> Detection | None:
    if one is None:
        return None
    numbers = (one.x1_px, one.y1_px, one.x2_px, one.y2_px, one.score)
    if (not all(abs(number) <= _FURTHEST_PX for number in numbers) or not 0 <= one.score <= 1
            or one.x1_px > one.x2_px or one.y1_px > one.y2_px):
        raise ValueError("returned a target with an invalid box or score")
    if wrong := annotation_problem(one):
        raise ValueError(f"returned a target with {wrong}")
    if all(isinstance(number, float) for number in numbers):
        return one  # the same object, because the overlay finds it among the detections
    x1_px, y1_px, x2_px, y2_px, score = map(float, numbers)
    return replace(one, x1_px=x1_px, y1_px=y1_px, x2_px=x2_px, y2_px=y2_px, score=score)


def _failed(error: BaseException) -> Plan:
    return Plan(STILL, "failed", f"{type(error).__name__}: {report_fault('mission', error)}"[:200], done=True)
