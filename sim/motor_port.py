"""Where motor commands arrive: stamped, logged, latched. Shell (clock, file); called from the receiving thread.

The log is what stopping is judged by, so a line is with the kernel before its command is obeyed, and survives kill -9.
"""

import math
from pathlib import Path

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError
from sightline.sim.bus import MOTION_SET

LOG_HEADER = b"t_us,left_rad_s,right_rad_s,left_rad,right_rad\n"


class MotorPort:
    """Holds the last speeds given; nobody's leaving changes them, as with real PWM."""

    def __init__(self, log_path: str | None) -> None:
        self.speeds_rad_s = (0.0, 0.0)
        self.angles_rad = (0.0, 0.0)
        """How far each wheel has turned, as the physics last said."""
        self.refused = 0
        try:
            self._log = Path(log_path).open("wb", buffering=0) if log_path else None  # noqa: SIM115  closed by close()
        except OSError as error:
            raise ConfigError(f"motor_log {log_path}: {error.strerror}; name a file in a folder that exists") from None
        if self._log:
            self._log.write(LOG_HEADER)

    def take(self, data: bytes) -> None:
        """One packet from a drive; what is no pair of finite speeds is counted and changes nothing."""
        t_us = monotonic_us()
        speeds = MOTION_SET.unpack(data) if len(data) == MOTION_SET.size else (math.nan, math.nan)
        if not all(map(math.isfinite, speeds)):
            self.refused += 1
            return
        if self._log:
            left_rad, right_rad = self.angles_rad
            self._log.write(b"%d,%.5f,%.5f,%.5f,%.5f\n" % (t_us, *speeds, left_rad, right_rad))
        self.speeds_rad_s = (speeds[0], speeds[1])

    def close(self) -> None:
        """Close the log."""
        if self._log:
            self._log.close()
