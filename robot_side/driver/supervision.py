"""Which signals end the driver. Pure, and light: the robot's tools need no driver for it."""

import signal
from typing import Final

EXIT_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""Whatever a key or a terminal can send ends it by way of zero, Ctrl-\\ and Ctrl-Z too: a driver that is killed or held
up on the spot leaves the wheels turning."""
IGNORED_SIGNALS: Final = (signal.SIGTTIN, signal.SIGTTOU)
"""Nor may a terminal that it is in the background of hold it up."""
