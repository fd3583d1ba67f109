"""A range scan off the wire -> `RangeScan`, bounded; nothing that is no number gets any further. Pure."""

import numpy as np

from sightline.protocol.channels import SCAN
from sightline.protocol.codec import check_sizes, decode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import ScanHeader
from sightline.protocol.refusals import RejectReason
from sightline.vision_side.missions.port import RangeScan


def decode_scan(header: bytes, payload: bytes) -> tuple[ScanHeader, RangeScan]:
    """The scan and its stamp.

    Raises WireError: MALFORMED for broken headers and sizes, NOT_FINITE for a nan or a negative range.
    """
    check_sizes(SCAN, header, payload)
    stamp = decode(ScanHeader, header)
    if len(payload) % 4:
        raise WireError(RejectReason.MALFORMED, f"scan payload of {len(payload)} bytes is no whole number of float32")
    ranges_m = np.frombuffer(payload, "<f4").astype(np.float32, copy=False)
    if not (ranges_m >= 0).all():  # false for a nan too
        raise WireError(RejectReason.NOT_FINITE, "scan holds a nan or negative range")
    scan = RangeScan(stamp.t_us, stamp.angle_min_rad, stamp.angle_increment_rad, stamp.range_min_m, stamp.range_max_m,
                     ranges_m)
    return stamp, scan
