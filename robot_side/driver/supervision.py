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
"""Signals of supervisors, keys and terminals, also Ctrl-\\ and Ctrl-Z. The driver sets the wheels to zero before it
ends, because a driver that is killed or stopped leaves the wheels turning."""
IGNORED_SIGNALS: Final = (signal.SIGTTIN, signal.SIGTTOU)
"""Signals that would stop a process in the background of a terminal."""


# Requests of the driver process to the operating system: real-time scheduling, and a watchdog. Shell.
#
# A part without permission is logged once at start. The robot runs without it.


# Above ordinary threads and kernel soft interrupts, below kernel watchdogs. The guardian ends a driver in a loop.
DRIVER_PRIORITY: Final = 50
GUARDIAN_PRIORITY: Final = 51
_MCL_CURRENT_AND_FUTURE: Final = 3
_MCL_ONFAULT: Final = 4  # lock used pages only, so that the process does not grow


def schedule_real_time(priority: int, thread: int = 0) -> bool:
    """Request real-time scheduling for a thread, not for its children. Returns False if it is not permitted."""
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, AttributeError):
        return False
    return True


def request_real_time(priority: int) -> Iterator[str]:
    """Freeze the garbage collector, request real-time scheduling, lock the memory. Yields the failures."""
    gc.collect()
    gc.freeze()
    if not schedule_real_time(priority):
        yield "real-time scheduling is not permitted (needs CAP_SYS_NICE or LimitRTPRIO); ticks may be late under load"
    libc = ctypes.CDLL(None, use_errno=True)
    flags = _MCL_CURRENT_AND_FUTURE | (_MCL_ONFAULT if priority == GUARDIAN_PRIORITY else 0)
    if not hasattr(libc, "mlockall") or libc.mlockall(flags) != 0:
        yield "locking memory is not permitted (needs CAP_IPC_LOCK or LimitMEMLOCK); swapping may delay a tick"


def limit_core_dump() -> None:
    """Disable core dumps. During a dump the motors would keep their speed until it is on disk."""
    hard = resource.getrlimit(resource.RLIMIT_CORE)[1]
    # Not 0, because a dump into a program ignores 0. Source: core(5).
    resource.setrlimit(resource.RLIMIT_CORE, (1 if hard else 0, hard))


class SystemdNotifier:
    """systemd's notification socket (sd_notify(3)). Without the socket every call does nothing."""

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
                return  # the watchdog detects the silence
