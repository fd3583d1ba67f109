"""The track against a Kalman filter in matrices, and its gate and times with numbers."""

import pytest

from sightline.vision_side.config import TrackConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.locate import Sighting
from sightline.vision_side.tracking.track import Track

HERE = (0.0, 0.0, 0.0)


def at(x_m, y_m=0.0, score=1.0):
    return Sighting(x_m, y_m, Detection(0, 0, 1, 1, score, "target"))


@pytest.mark.parametrize(("x_m", "score", "sigma_m"), [(1.0, 1.0, 0.008), (2.0, 1.0, 0.032), (1.0, 0.5, 0.032)])
def test_noise_of_a_position_grows_with_the_square_of_the_range(x_m, score, sigma_m):
    """One sigma is `range_noise` at 1 m, four times that at 2 m, and at half the score."""
    track = Track(TrackConfig(range_noise=0.008, acceleration_mps2=0.35))
    track.step(0.1, HERE, [at(x_m, 0.0, score)])
    track.step(0.1, HERE, [at(x_m, 0.01, score)])
    predicted = sigma_m**2 + 0.3**2 * 0.1**2 + 0.35**2 * 0.1**3 / 3  # position, velocity of 0.3 m/s, acceleration
    share = predicted / (predicted + sigma_m**2)
    assert track.target.y_m == pytest.approx(0.01 * share, rel=1e-3)
