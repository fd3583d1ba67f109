"""The wheel that users install: one package at the top, and a simulation that drives from it in any folder."""

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent


def run(*command: str, cwd: Path, **environ: str) -> str:
    done = subprocess.run(command, cwd=cwd, env=os.environ | environ, capture_output=True, text=True, timeout=180,
                          check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build_elsewhere = folder / "build.cfg"  # what an earlier build left in the checkout would be taken for its state
    build_elsewhere.write_text(f"[build]\nbuild_base = {folder / 'build'}\n[egg_info]\negg_base = {folder}\n")
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation",
        "--wheel-dir", str(folder), str(ROOT), cwd=folder, DIST_EXTRA_CONFIG=str(build_elsewhere))
    (found,) = folder.glob("sightline_robot-*.whl")
    return found


@pytest.mark.slow
def test_the_wheel_has_one_package_at_its_top_with_its_data(wheel):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    folders = [folder.name for folder in (ROOT / ".import/sightline").iterdir() if folder.is_dir()]
    files = [path.relative_to(ROOT) for name in folders for path in (ROOT / name).rglob("*") if path.is_file()]
    assert names == {"sightline/__init__.py", "sightline/py.typed"} | {
        f"sightline/{path}" for path in files if "__pycache__" not in path.parts}


@pytest.mark.alone  # beside other tests the demo does not reach its bounds
def test_the_demo_drives_from_the_wheel_in_a_folder_that_shadows_our_names(wheel, tmp_path):
    """An environment with the wheel and the dependencies alone: no checkout is on its path."""
    environment, folder = tmp_path / "environment", tmp_path / "folder"
    run(sys.executable, "-m", "venv", "--without-pip", str(environment), cwd=tmp_path)
    packages = next(environment.glob("lib/python*/site-packages"))
    zipfile.ZipFile(wheel).extractall(packages)
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    folder.mkdir()
    for name in ("sim", "protocol", "robot_side", "vision_side"):
        (folder / f"{name}.py").write_text("raise SystemExit('a file of the current folder was imported')")
    python = str(environment / "bin/python")
    where = run(python, "-P", "-c", "import sightline.sim; print(sightline.sim.__file__)", cwd=folder)
    assert Path(where.strip()).is_relative_to(packages)
    command = (python, "-P", "-m", "sightline.operator_side.cli.app", "demo", "--seconds", "5")
    assert "ok" in run(*command, cwd=folder, PYTHONPATH=".")
