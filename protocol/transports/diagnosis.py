"""Which process listens on a TCP port, for the error text of a port in use. Shell (reads /proc; Linux only)."""

from pathlib import Path

_LISTEN = "0A"


def port_owner(port: int) -> str:
    """`python3 (pid 4711)` for the process listening on TCP `port`; "" where that cannot be found out."""
    sockets = {f"socket:[{inode}]" for table in ("tcp", "tcp6") for inode in _listening_inodes(table, port)}
    for process in Path("/proc").glob("[0-9]*") if sockets else ():
        if any(_target(link) in sockets for link in _descriptors(process)):
            return f"{_name(process)} (pid {process.name})"
    return ""


def _listening_inodes(table: str, port: int) -> list[str]:
    try:
        rows = Path("/proc/net", table).read_text("ascii").splitlines()[1:]
    except OSError:
        return []
    fields = [row.split() for row in rows]
    return [row[9] for row in fields if row[3] == _LISTEN and int(row[1].rpartition(":")[2], 16) == port]


def _descriptors(process: Path) -> list[Path]:
    """The process's open files; none if it is gone or not ours to look at."""
    try:
        return list((process / "fd").iterdir())
    except OSError:
        return []


def _target(descriptor: Path) -> str:
    try:
        return str(descriptor.readlink())
    except OSError:  # closed meanwhile
        return ""


def _name(process: Path) -> str:
    try:
        return (process / "comm").read_text("utf-8", "replace").strip()
    except OSError:
        return "a process"
