"""Real-time scheduling, systemd watchdog, and the signals that end the driver. Shell."""

import ctypes
import gc
import os
import resource
import signal
import socket
from collections.abc import Iterator
from typing import Final

EXIT_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""Whatever a key or a terminal can send ends it by way of zero, Ctrl-\\ and Ctrl-Z too: a driver that is killed or held
up on the spot leaves the wheels turning."""
IGNORED_SIGNALS: Final = (signal.SIGTTIN, signal.SIGTTOU)
"""Nor may a terminal that it is in the background of hold it up."""


# What the driver process requests of the operating system: punctuality, and a watchdog. Shell.
#
# Each part that is not permitted is logged once at start; the robot runs without it.


# Above ordinary threads and the kernel's own soft work, below its watchdogs. The guardian ends a driver in a loop.
DRIVER_PRIORITY: Final = 50
GUARDIAN_PRIORITY: Final = 51
_MCL_CURRENT_AND_FUTURE: Final = 3
_MCL_ONFAULT: Final = 4  # only what is in use, so that it does not grow


def schedule_real_time(priority: int, thread: int = 0) -> bool:
    """Request real-time scheduling for a thread, not for what it starts. Returns False if it is not permitted."""
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def request_real_time(priority: int) -> Iterator[str]:
    """Freeze the garbage collector's survivors, request real-time scheduling and locked memory; yields what failed."""
    gc.collect()
    gc.freeze()
    if not schedule_real_time(priority):
        yield "real-time scheduling is not permitted (needs CAP_SYS_NICE or LimitRTPRIO); ticks may be late under load"
    libc = ctypes.CDLL(None, use_errno=True)
    flags = _MCL_CURRENT_AND_FUTURE | (_MCL_ONFAULT if priority == GUARDIAN_PRIORITY else 0)
    if not hasattr(libc, "mlockall") or libc.mlockall(flags) != 0:
        yield "locking memory is not permitted (needs CAP_IPC_LOCK or LimitMEMLOCK); swapping may delay a tick"


def limit_core_dump() -> None:
    """Write no core dump of this process: the motors would keep their speed until the last byte is on the disk."""
    hard = resource.getrlimit(resource.RLIMIT_CORE)[1]
    # Not 0: a dump into a program ignores that value. Source: core(5).
    resource.setrlimit(resource.RLIMIT_CORE, (1 if hard else 0, hard))


class SystemdNotifier:
    """systemd's notification socket (sd_notify(3)); without one every call does nothing."""

    def __init__(self) -> None:
        address = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None

    @property
    def is_active(self) -> bool:
        """Return True if a service manager supervises this process."""
        return self._socket is not None

    def notify(self, state: str) -> None:
        """Send e.g. READY=1, WATCHDOG=1, STOPPING=1; never waits."""
        if self._socket is not None:
            try:
                self._socket.sendto(state.encode(), socket.MSG_DONTWAIT, self._address)
            except OSError:
                return  # the watchdog will notice the silence
