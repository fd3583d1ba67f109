"""Drives for real robot processes whose wheels never stop. Shell (a file and a clock)."""

from sightline.protocol.clock import monotonic_us
from sightline.robot_side.hardware.log_drive import LogDrive
from sightline.robot_side.ports import WheelAngles


class CoastingDrive(LogDrive):
    """Only ever goes faster: what the driver commands to slow down is ignored."""

    fastest = (0.0, 0.0)

    def set(self, left_rad_s, right_rad_s):
        """Log and turn by the fastest speeds so far."""
        if abs(left_rad_s) + abs(right_rad_s) > abs(self.fastest[0]) + abs(self.fastest[1]):
            self.fastest = (left_rad_s, right_rad_s)
        super().set(*self.fastest)


class BlindCoastingDrive(CoastingDrive):
    """Coasts, and its encoders stand still: only its log shows the wheels."""

    def wheels(self):
        """Return the angles of wheels at rest, except to the base class, which turns by them."""
        return WheelAngles(0.0, 0.0, monotonic_us())
