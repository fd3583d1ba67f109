"""The steps of CI for other Pythons and other machines, where they find something and where they find nothing."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture
def programs(tmp_path) -> Path:
    """A folder with all programs that .ci/other_python may find; apt and uv find nothing."""
    for name in ("bash", "dirname", "env"):
        (tmp_path / name).symlink_to(shutil.which(name))
    for name in ("apt-get", "uv"):
        script(tmp_path / name, "exit 1")
    script(tmp_path / "make", 'echo "$@"; echo "demanded: ${TESTS_DEMAND-nothing}"')
    return tmp_path


def script(path: Path, text: str) -> None:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


def other_python(step: str, programs: Path) -> subprocess.CompletedProcess:
    environ = {"PATH": str(programs), "HOME": str(programs), "TESTS_DEMAND": "triton"}
    return subprocess.run([ROOT / ".ci/other_python", step], env=environ, capture_output=True, text=True, timeout=60,
                          check=False)


@pytest.mark.parametrize(("step", "goal"), [("build", "test-environment"), ("test", "test")])
def test_newest_other_python_is_used_in_its_own_environment(programs, step, goal):
    script(programs / "python3.12", "exit 0")
    script(programs / "python3.13", "exit 1")
    assert f"{goal} VENV=.venv-3.12 PYTHON={programs}/python3.12" in other_python(step, programs).stdout
    script(programs / "python3.13", "exit 0")
    done = other_python(step, programs)
    assert f"{goal} VENV=.venv-3.13 PYTHON={programs}/python3.13" in done.stdout and done.returncode == 0
    assert "demanded: nothing" in done.stdout


def test_build_fails_where_the_environment_cannot_be_made(programs):
    script(programs / "python3.13", "exit 0")
    script(programs / "make", '[ "$2" != test-environment ]')
    assert other_python("build", programs).returncode == 1
    script(programs / "make", '[ "$2" = test-environment ]')
    assert other_python("build", programs).returncode == 0, "tests that cannot be collected fail in their own step"


def test_failed_tests_of_another_python_fail_the_step(programs):
    script(programs / "python3.13", "exit 0")
    script(programs / "make", "exit 2")
    assert other_python("test", programs).returncode == 2


def test_missing_other_python_gives_one_line(programs):
    done = other_python("test", programs)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == ("not run: the tests with another Python, since neither 3.13 nor 3.12 was found or could be "
                           "installed\n")


def resolve(**pip: str) -> subprocess.CompletedProcess:
    environ = os.environ | {"PIP_CONFIG_FILE": os.devnull, "PIP_EXTRA_INDEX_URL": "", "PIP_FIND_LINKS": "",
                            "PIP_RETRIES": "0"} | pip
    return subprocess.run([sys.executable, ROOT / ".ci/resolve_aarch64"], env=environ, capture_output=True, text=True,
                          timeout=120, check=False)


@pytest.mark.slow
def test_extra_that_does_not_resolve_on_a_raspberry_pi_fails_with_one_line(tmp_path):
    with zipfile.ZipFile(tmp_path / "packaging-99-py3-none-any.whl", "w") as reachable:
        reachable.writestr("packaging-99.dist-info/METADATA", "Metadata-Version: 2.1\nName: packaging\nVersion: 99\n")
        reachable.writestr("packaging-99.dist-info/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
    done = resolve(PIP_NO_INDEX="1", PIP_FIND_LINKS=str(tmp_path))
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1
    assert line.startswith("error: aarch64, Python 3.11, [zenoh,websocket] does not resolve: ERROR: No matching")


@pytest.mark.slow
def test_unreachable_index_gives_one_line():
    done = resolve(PIP_INDEX_URL="http://127.0.0.1:9/simple")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == ("aarch64, Python 3.11, [zenoh,websocket]: not checked, since the package index cannot be "
                           "reached\n")


def test_no_function_of_ci_hides_a_program_that_it_looks_for():
    """`command -v` finds functions too, so a program of the same name would never be installed."""
    for path in [ROOT / ".ci" / name for name in ("run", "engine", "other_python")]:
        text = path.read_text()
        functions = set(re.findall(r"^(\w+)\(\)", text, re.MULTILINE))
        assert functions
        assert not functions & set(re.findall(r"command -v ([\w.-]+)", text)), path
