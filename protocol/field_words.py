"""What each field on the wire means and in which unit it is, for the specification's tables. Pure.

One table by field name; `Model.field` where a name means something else there. The unit follows from the name's ending.
"""

from typing import Final

UNITS: Final = {
    "_mps": "m/s",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_us": "µs",
    "_px": "px",
    "_m": "m",
    "fps": "1/s",
    "_percent": "%",
    "pose": "m, m, rad",
    "moving": "m/s, rad/s",
    "applied": "m/s, rad/s",
}
"""Ending of a name -> unit; the first that fits."""

MEANINGS: Final = {
    "v": "version of this protocol",
    "session": "the sender's start: 8 hex digits drawn at random",
    "seq": "count of the sender's messages on this channel within the session",
    "t_us": "the robot's monotonic clock: capture of a frame or scan, else publishing",
    "pose": "odometry: x, y, yaw",
    "moving": "measured at the wheels: linear, angular",
    "applied": "last given to the wheels, after every limit: linear, angular",
    "latency_us": "capture to accepted command, the robot's own measure, of the last accepted command",
    "source": "the sender's role; equal to the one in the key",
    "echo": "what this message answers, field for field",
    "compute_us": "how long the sender computed, from receiving the frame to sending this",
    "RequestHeader.echo": "the newest `status` seen",
    "DetectionsHeader.echo": "the frame that was looked at",
    "angle_min_rad": "direction of the first ray; 0 is ahead, left positive",
    "angle_increment_rad": "from one ray to the next",
    "range_min_m": "smaller ranges mean nothing",
    "range_max_m": "larger ranges mean nothing",
    "id": "the asker's own count of requests",
    "verb": "what is asked",
    "to": "session of who asked",
    "Reply.id": "of the request",
    "ok": "whether it was done, or was so already",
    "state": "of the gate, afterwards",
    "detail": "one line for a person; of a refused request `REASON: words`",
    "Status.state": "of the gate",
    "reason": "why it is in this state, one line for a person",
    "holder": "who drives; null for nobody",
    "frame_age_us": "of the frame behind the command in force; null without one",
    "accepted": "commands accepted since the start",
    "refused": "refusals since the start, by reason",
    "last_refusal": "the newest refusal",
    "LastRefusal.source": "role in the key of what was refused",
    "LastRefusal.reason": "as counted in `refused`",
    "LastRefusal.detail": "one line for a person",
    "stream": "the flow of frames",
    "auto_arm": "whether the robot arms without a person",
    "tick_late_max_us": "the latest that a tick of the driver's loop was",
    "network_restarts": "how often the network process was started again",
    "max_linear_mps": "limit of speed",
    "max_angular_rad_s": "limit of turning",
    "sent": "frames sent",
    "credit_timeouts": "frames whose answer never came",
    "window": "frames that may be in flight",
    "fps": "frames sent in the last second",
    "dropped_commands": "commands that the driver did not take in time",
    "refused_pictures": "pictures of the camera too large or not newer than the last",
    "overtaken": "frames that a newer one replaced on the way",
    "dropped": "by channel: what a newer one replaced before a peer had room for it",
    "missed_captures": "pictures of the camera that nobody asked for in time",
    "quality_percent": "of the configured JPEG quality, to fit the link",
    "scale_percent": "of the configured side lengths, to fit the link",
    "calibrated": "whether the camera's model was measured",
    "channel": "which of its channels",
    "Echo.session": "the robot's",
    "Echo.seq": "as in that message",
    "Echo.t_us": "as in that message",
    "width_px": "width of the picture as encoded",
    "height_px": "height of the picture as encoded",
    "fx_px": "focal length, across",
    "fy_px": "focal length, down",
    "cx_px": "principal point, from the left",
    "cy_px": "principal point, from the top",
    "distortion": "k1, k2, p1, p2, k3 ... in OpenCV's order; empty for none",
    "x_m": "the lens, ahead of the axle's middle",
    "y_m": "the lens, left of it",
    "z_m": "the lens, above the floor",
    "pitch_rad": "upwards positive",
    "boxes": "best first; empty means looked, and saw nothing",
    "label": "what it is, the detector's word",
    "score": "how sure the detector is",
    "x1_px": "left edge",
    "y1_px": "top edge",
    "x2_px": "right edge, exclusive; not left of `x1_px`",
    "y2_px": "bottom edge, exclusive; not above `y1_px`",
    "circle": "where the detector knows one",
    "track": "the detector's number for an object that it follows",
    "DetectedCircle.cx_px": "centre, from the left",
    "DetectedCircle.cy_px": "centre, from the top",
    "radius_px": "radius",
    "robot": "the robot's id; of who connects, the one it means",
    "role": "`source` of what the sender says towards the robot; empty or `robot` for a robot",
    "wants": "channels that the other end is to send; unknown names are ignored",
}


def unit_of(field: str) -> str:
    """The unit of `field`; "" for a number without one and for text."""
    return next((unit for ending, unit in UNITS.items() if field.endswith(ending)), "")


def meaning_of(model: str, field: str) -> str:
    """What `field` of `model` means; "" where nobody has said so."""
    return MEANINGS.get(f"{model}.{field}", MEANINGS.get(field, ""))
