"""Latency estimate and Smith predictor: the pose of the robot when a command acts. Pure.

Before a command acts, the robot still applies the commands in flight. Steering from the image alone corrects the same
error several times. Steering from the predicted pose does not.
"""

import math
from collections import deque
from dataclasses import dataclass

from sightline.protocol.messages import Pose, Twist
from sightline.vision_side.config import LatencyConfig

# About half a frame at 30 fps, so that the heading changes little within a step.
_STEP_S = 0.015
_STILL = 1e-6
# Commands: two seconds at 30 fps, five times the longest latency.
_REMEMBERED = 64


@dataclass(frozen=True, slots=True)
class PredictedMotion:
    """Pose in the odometry frame and twist about the robot."""

    pose: Pose
    linear_mps: float
    angular_rad_s: float


class LatencyEstimator:
    """Smooths the delay from capture to action."""

    def __init__(self, config: LatencyConfig) -> None:
        self._config = config
        self.measured_s = config.first_guess_s
        """Time from capture to accepted command, s."""

    @property
    def total_s(self) -> float:
        """Return the time from capture to the motion of the wheels, s."""
        return min(self.measured_s, self._config.max_s) + self._config.actuation_s

    def measure(self, latency_us: int | None, dt_s: float) -> None:
        """Update the estimate.

        Args:
            latency_us: the robot's measurement from capture to accepted command, or None.
            dt_s: time since the last frame.
        """
        if latency_us is None:
            return
        # Smoothing is per elapsed time, so that it does not depend on the frame rate.
        share = min(1.0, dt_s / self._config.smoothing_s)
        self.measured_s += share * (min(latency_us / 1e6, self._config.max_s) - self.measured_s)


class MotionPredictor:
    """Predicts the robot from its latency and the commands in flight."""

    def __init__(self, config: LatencyConfig) -> None:
        self._config = config
        self._latency = LatencyEstimator(config)
        self._sent: deque[tuple[int, float, float]] = deque(maxlen=_REMEMBERED)

    @property
    def latency_s(self) -> float:
        """Return the time from capture to the motion of the wheels, s."""
        return self._latency.total_s

    def measure(self, latency_us: int | None, dt_s: float) -> None:
        """Update the latency, see `LatencyEstimator.measure`."""
        self._latency.measure(latency_us, dt_s)

    def sent(self, t_us: int, twist: Twist) -> None:
        """Note the command that answers the frame captured at `t_us`."""
        self._sent.append((t_us, twist.linear_mps, twist.angular_rad_s))

    def expected(self, t_us: int) -> tuple[float, float] | None:
        """Return the twist that the robot should apply at `t_us`, (m/s, rad/s), or None before the first one."""
        for sent_us, linear, angular in reversed(self._sent):
            if sent_us + self._latency.measured_s * 1e6 <= t_us:
                return linear, angular
        return None

    def motion(
        self, t_us: int, pose: Pose, moving: tuple[float, float], applied: tuple[float, float]
    ) -> PredictedMotion:
        """Predict pose and twist when a command sent now takes effect.

        Args:
            t_us: capture time of the frame.
            pose: odometry at that time, m, m, rad.
            moving: measured twist, m/s, rad/s.
            applied: twist on the wheels, m/s, rad/s.

        Returns:
            Pose and twist after the latency.

        Source: Smith predictor.
        """
        # A robot in HOLD applies no command in flight, so it stays where it is.
        if self._is_held(t_us, applied):
            return PredictedMotion(pose, 0.0, 0.0)
        (x, y, yaw), (linear, angular) = pose, moving
        for length_s, goal in self._under_way(t_us, moving):
            steps = max(1, round(length_s / _STEP_S))
            for _ in range(steps):
                step_s = length_s / steps
                linear += _bounded(goal[0] - linear, self._config.linear_acceleration_mps2 * step_s)
                angular += _bounded(goal[1] - angular, self._config.angular_acceleration_rad_s2 * step_s)
                # The heading in the middle of the step, so that an arc ends at the right place.
                middle = yaw + angular * step_s / 2
                x, y = x + linear * math.cos(middle) * step_s, y + linear * math.sin(middle) * step_s
                yaw += angular * step_s
        return PredictedMotion((x, y, yaw), linear, angular)

    def _under_way(self, t_us: int, moving: tuple[float, float]) -> list[tuple[float, tuple[float, float]]]:
        """Return (seconds, twist) of the commands in flight between `t_us` and the effect of a new command."""
        spans: list[tuple[float, tuple[float, float]]] = []
        until_s = latency_s = self.latency_s
        for sent_us, linear, angular in reversed(self._sent):
            from_s = max(0.0, latency_s - (t_us - sent_us) / 1e6)
            if from_s < until_s:
                spans.append((until_s - from_s, (linear, angular)))
                until_s = from_s
            if from_s == 0.0:
                break
        # Before the oldest known command, e.g. after a restart, only the measured motion is known.
        if until_s > 0.0:
            spans.append((until_s, moving))
        return spans[::-1]

    def _is_held(self, t_us: int, applied: tuple[float, float]) -> bool:
        expected = self.expected(t_us)
        should_move = expected is not None and max(map(abs, expected)) > _STILL
        return should_move and max(map(abs, applied)) <= _STILL


def _bounded(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
