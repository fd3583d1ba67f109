"""Asks whether the boundary tables alone reach every line and branch of the judged files. Shell."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path


def uncovered(files: Iterable[str], suites: Iterable[str]) -> str:
    """What `suites` leave out of `files`, as a table for people; "" when it is nothing."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "COVERAGE_FILE": str(Path(folder, "data"))}
        coverage, include = [sys.executable, "-m", "coverage"], "--include=" + ",".join(files)
        run = [*coverage, "run", "--branch", include, "-m", "pytest", "-q", "-p", "no:cacheprovider", *suites]
        ran = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
        if ran.returncode:
            return ran.stdout + ran.stderr
        report = [*coverage, "report", include, "--show-missing", "--skip-covered", "--fail-under=100", "--precision=2"]
        told = subprocess.run(report, env=environment, capture_output=True, text=True, check=False)
    return told.stdout + told.stderr if told.returncode else ""
