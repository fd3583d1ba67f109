"""What a measurement ran on, in words that name no host. Shell (reads the system)."""

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Final

PACKAGES: Final = ("eclipse-zenoh", "pybullet", "opencv-python-headless", "pydantic")


def describe_machine() -> list[str]:
    """CPU, cores, load, kernel, Python and the packages that matter, one line each."""
    return [
        f"CPU: {_cpu_model()}, {os.cpu_count()} cores; load average at the start {os.getloadavg()[0]:.1f}",
        f"system: {platform.system()} {platform.release()}, {platform.machine()}",
        f"Python {platform.python_version()}; " + ", ".join(f"{name} {version(name)}" for name in PACKAGES),
    ]


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")
