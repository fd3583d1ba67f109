"""The search, image by image: when it begins, which way it turns, and what its budget counts."""



from sightline.vision_side.config import SearchConfig
from sightline.vision_side.tracking.steering import Search

RATE = (0.0, 0.6)
"""Applied while it turns, m/s and rad/s."""


def turns(search, yaw_rad, dt_s=0.1, applied=RATE):
    """Return True if the search turns at this heading."""
    return search.step(dt_s, (0.0, 0.0, yaw_rad), applied) is not None


def test_turn_across_the_wrap_of_the_heading_counts_by_its_size():
    """From 3.1 to -3.1 rad the robot turned by 0.083 rad, not by 6.2."""
    search = Search(SearchConfig(after_s=0.0, max_turn_rad=0.2))
    assert turns(search, 3.1)
    assert turns(search, -3.1), "0.083 of 0.2"
    assert turns(search, 3.1), "0.166 of 0.2, and back across"
    assert not turns(search, -3.1), "0.249 of 0.2"
