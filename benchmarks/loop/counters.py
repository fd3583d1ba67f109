"""What the kernel counted: time and memory of processes, time taken by others. Shell (/proc)."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_TICKS_PER_S: Final = os.sysconf("SC_CLK_TCK")
_IDLE, _IOWAIT, _STEAL = 3, 4, 7  # columns of /proc/stat, proc(5)


@dataclass(frozen=True, slots=True)
class Reading:
    """The kernel's counters at one moment. `busy_s` is of all processes together, `steal_s` is the hypervisor's."""

    cpu_s: Mapping[str, float]
    own_s: float
    busy_s: float
    steal_s: float


def read_machine(pids: Mapping[str, int]) -> Reading:
    """Read now. Raises OSError if a process is gone."""
    columns = [int(text) / _TICKS_PER_S for text in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return Reading(
        cpu_s={name: _cpu_s(pid) for name, pid in pids.items()},
        own_s=_cpu_s(os.getpid()),
        busy_s=sum(columns) - columns[_IDLE] - columns[_IOWAIT] - columns[_STEAL],
        steal_s=columns[_STEAL],
    )


def taken_percent(before: Reading, after: Reading, seconds: float) -> float:
    """Share of the machine's time that neither we nor idleness had: stolen by the hypervisor, or of other processes."""
    ours_s = after.own_s - before.own_s + sum(after.cpu_s[name] - before.cpu_s[name] for name in after.cpu_s)
    others_s = max(0.0, after.busy_s - before.busy_s - ours_s) + after.steal_s - before.steal_s
    return 100 * others_s / (seconds * (os.cpu_count() or 1))


def high_water_mb(pid: int) -> float:
    """The most memory the process has had in use, in MB of 2**20 bytes."""
    return _status_mb(pid, "VmHWM")


def resident_mb(pid: int) -> float:
    """The memory the process has in use now, in MB of 2**20 bytes."""
    return _status_mb(pid, "VmRSS")


def children_of(pid: int) -> list[int]:
    """Process ids of the children that its threads started."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return [int(text) for task in tasks for text in (task / "children").read_text().split()]


def _status_mb(pid: int, name: str) -> float:
    return _field_kib(Path(f"/proc/{pid}/status").read_text().splitlines(), name) / 1024


def _field_kib(lines: Iterable[str], name: str) -> int:
    return next(int(line.split()[1]) for line in lines if line.startswith(name + ":"))


def _cpu_s(pid: int) -> float:
    # The command's name stands in brackets and may hold anything; what is numbered from 3 on follows it.
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
