"""Contract of every detector plug-in. Run it over your own: `assert_kept(lambda: Mine(Mine.Config()))`.

The promises themselves ship with vision (vision_side/detect/contract.py): `sightline detector check NAME` runs them.
"""

from collections.abc import Callable

from sightline.vision_side.detect.contract import check_detector
from sightline.vision_side.detect.port import Detector


def assert_kept(make: Callable[[], Detector], seed: int = 7) -> None:
    """Every promise in turn; an AssertionError names those that are broken."""
    broken = [f"{one.promise}: {one.wrong}" for one in check_detector(make, seed) if one.wrong]
    assert not broken, "; ".join(broken)
