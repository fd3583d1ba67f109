"""A wall clock that is wrong, in every Python process that starts with this folder on its path. Shell (files)."""

from pathlib import Path

from sightline.operator_side.faults.ledger import INJECTED


def write_wrong_clock(folder: Path, offset_s: str) -> None:
    """Leave a `sitecustomize` that adds the Python expression `offset_s` to `time.time`; each process notes it."""
    (folder / "sitecustomize.py").write_text(
        f"""import time
right, right_ns = time.time, time.time_ns
time.time = lambda: right() + ({offset_s})
time.time_ns = lambda: right_ns() + int(({offset_s}) * 1e9)
with open({str(folder / "clock.ledger")!r}, "a") as ledger:
    ledger.write(f"{INJECTED},{{time.monotonic_ns() // 1000}},0\\n")
""",
        "utf-8",
    )
