"""The latency estimate and the prediction, with numbers from the equations of motion."""


from sightline.protocol.messages import Twist
from sightline.vision_side.config import LatencyConfig
from sightline.vision_side.tracking.prediction import MotionPredictor


def twist(linear_mps, angular_rad_s=0.0):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def test_command_is_expected_on_the_wheels_from_its_latency_on_and_not_before():
    """The latency is in seconds, the times are in microseconds: 0.1 s after the capture at 5 s."""
    predictor = MotionPredictor(LatencyConfig(first_guess_s=0.1))
    predictor.sent(4_000_000, twist(0.1, 0.5))
    predictor.sent(5_000_000, twist(0.2, -0.5))
    assert predictor.expected(4_099_999) is None
    assert predictor.expected(4_100_000) == (0.1, 0.5)
    assert predictor.expected(5_099_999) == (0.1, 0.5)
    assert predictor.expected(5_100_000) == (0.2, -0.5)
