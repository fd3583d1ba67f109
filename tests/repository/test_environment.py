"""The set-up of `make demo` and `make test`: what it installs, and one line for each cause that stops it."""

import importlib.metadata
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent.parent
DEMO, ALL = ROOT / "requirements-demo.lock", ROOT / "requirements.lock"
OWN = "{}.{}.{}".format(*sys.version_info[:3])
# Stands for the Python of an environment: reports a version, notes each call, and does what FAKE_PIP names.
FAKE_PYTHON = """#!/bin/sh
case "$*" in *version_info*) echo "${FAKE_VERSION:-OWN}"; exit 0;; esac
echo "$@" >> "$FAKE_LOG"
case "$*" in
*"-m pip"*" wheel "*)
    while [ "$1" != --wheel-dir ]; do shift; done
    mkdir -p "$2" && echo wheel > "$2/pybullet-3.2.7-any.whl"
    exit ${FAKE_BUILD:-0};;
*"-m pip"*" install "*) eval "${FAKE_PIP:-:}";;
esac
""".replace("OWN", OWN)


@pytest.fixture(scope="module")
def environment():
    spec = importlib.util.spec_from_file_location("environment", ROOT / "environment.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture
def calls(tmp_path, monkeypatch) -> Path:
    """The file that receives one line for each call of a fake Python; nothing outside `tmp_path` is written."""
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "calls"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS", "VENV", "PYTHON", "ARGS"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "calls"


@pytest.fixture
def venv(tmp_path, calls) -> Path:
    """An environment whose Python is fake."""
    folder = tmp_path / "venv"
    (folder / "bin").mkdir(parents=True)
    (folder / "pyvenv.cfg").touch()
    executable(folder / "bin/python", FAKE_PYTHON)
    installed_as(folder, editable=True)
    return folder


@pytest.fixture
def stored(environment, calls) -> None:
    """A compiled PyBullet in the cache, so that a Python without a wheel of PyBullet has nothing to compile."""
    wheel = environment.stored_wheel(DEMO)
    wheel.parent.mkdir(parents=True)
    wheel.touch()


def installed_as(venv: Path, *, editable: bool) -> None:
    """Let an environment have Sightline as pip records it."""
    record = venv / "lib/python3/site-packages/sightline_robot-1.dist-info/direct_url.json"
    record.parent.mkdir(parents=True, exist_ok=True)
    record.write_text(json.dumps({"url": ROOT.as_uri(), "dir_info": {"editable": True} if editable else {}}))


def executable(path: Path, text: str) -> Path:
    path.write_text(text)
    path.chmod(0o755)
    return path


def make(*words: str) -> tuple[int, list[str]]:
    """Exit code of `make` and its lines on stderr, without those of make itself."""
    done = subprocess.run(["make", *words], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, [line for line in done.stderr.splitlines() if not re.match(r"make(\[\d+\])?: ", line)]


def set_up(goal: str, venv: Path) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "environment.py", goal, venv], cwd=ROOT, capture_output=True, text=True,
                          timeout=60, check=False)


def test_python_that_is_too_old_gives_one_line(tmp_path, calls):
    old = executable(tmp_path / "python3.9", '#!/bin/sh\n[ "$1" = --version ] && echo Python 3.9.18 || exit 1\n')
    done = subprocess.run(["make", "demo", f"PYTHON={old}"], cwd=ROOT, capture_output=True, text=True, check=False)
    (line,) = done.stdout.splitlines()
    assert done.returncode == 2
    assert line.startswith("error: ") and "Python 3.9.18" in line and line.endswith("PYTHON=/path/to/python3.11")


def test_environment_of_another_python_gives_one_line(venv, monkeypatch):
    monkeypatch.setenv("FAKE_VERSION", "3.9.18")
    code, lines = make("demo", f"PYTHON={sys.executable}", f"VENV={venv}")
    assert code == 2
    assert lines == [f"error: {venv} has Python 3.9.18, but PYTHON is {OWN}: run `make clean`, then `make demo`, "
                     "or pass PYTHON=python3.9"]


def test_environment_whose_python_is_gone_gives_one_line(venv):
    (venv / "bin/python").unlink()
    (venv / "bin/python").symlink_to("/no/such/python")
    code, lines = make("test", f"PYTHON={sys.executable}", f"VENV={venv}")
    assert (code, lines) == (2, [f"error: the Python of {venv} is gone: run `make clean`, then `make test`"])


def test_folder_without_environment_stays_as_it_is(tmp_path, calls):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat").touch()
    code, (line,) = make("demo", f"PYTHON={sys.executable}", f"VENV={tmp_path / 'photos'}")
    assert code == 2 and "is not a Python environment" in line
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["cat"]


@pytest.mark.parametrize("jobs", ["-j1", "-j4"])
def test_two_goals_run_one_after_the_other(venv, tmp_path, jobs):
    trace = tmp_path / "trace"
    for name in ("sightline", "python"):
        executable(venv / "bin" / name, f"#!/bin/sh\necho {name} >> {trace}\nsleep 0.3\necho end >> {trace}\n")
    idle = executable(tmp_path / "idle", "#!/bin/sh\n")
    assert make("demo", "test", jobs, f"PYTHON={idle}", f"VENV={venv}") == (0, [])
    assert trace.read_text().split() == ["sightline", "end", "python", "end"]


def test_two_goals_with_args_give_one_line(venv):
    code, (line,) = make("demo", "test", "ARGS=--seed 2", f"VENV={venv}")
    assert code == 2 and "ARGS is for one goal, but there are 2 (demo test): run `make` once for each" in line


def test_environment_is_set_up_once(stored, venv, calls):
    first, again = set_up("demo", venv), set_up("demo", venv)
    assert (first.returncode, again.returncode, again.stdout, again.stderr) == (0, 0, "", "")
    head = first.stdout.splitlines()[0]
    assert re.fullmatch(r"setting up \S+ for `make demo`: \d+ packages .*, \d+ MB installed, \d+ MB to down.*", head)
    installs = [line for line in calls.read_text().splitlines() if " install " in line]
    assert len(installs) >= 2 and "--require-hashes" in installs[0] and str(ROOT) in installs[-1]
    assert set_up("test", venv).returncode == 0 and (venv / ".test").exists()


def test_no_pip_replaces_setuptools_while_another_one_runs(stored, venv, tmp_path, monkeypatch):
    """A pip that builds a package in that moment fails: setuptools is not available in the build environment."""
    seen = tmp_path / "seen"
    note = f"if grep -q ^setuptools== $last; then kind=setuptools; fi; echo ${{kind:-others}} >> {seen}; sleep 0.3"
    monkeypatch.setenv("FAKE_PIP", f"for last; do :; done; {note}; echo end >> {seen}")
    assert set_up("test", venv).returncode == 0
    text = seen.read_text().split()
    assert text[:2] == ["setuptools", "end"] and "setuptools" not in text[2:]
    assert text[2:6] == ["others", "others", "end", "end"]


def test_a_copy_of_sightline_is_replaced_by_the_folder_itself(stored, venv, calls):
    """`pip install '.[metrics]'` in this environment makes a copy, which changes no stamp."""
    assert set_up("demo", venv).returncode == 0
    installed_as(venv, editable=False)
    calls.write_text("")
    assert "setting up" in set_up("demo", venv).stdout and f"--editable {ROOT}" in calls.read_text()


def test_interrupted_set_up_leaves_no_stamp_and_no_process(stored, venv, calls, monkeypatch):
    monkeypatch.setenv("FAKE_PIP", f"echo $$ > {venv}/pid; exec sleep 60")
    process = subprocess.Popen([sys.executable, "environment.py", "demo", venv], cwd=ROOT, stderr=subprocess.PIPE,
                               stdout=subprocess.DEVNULL, text=True)
    deadline = time.monotonic() + 30
    while not ((venv / "pid").exists() and (venv / "pid").read_text().strip()) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=30)[1] == "error: interrupted; run `make demo` again to go on\n"
    assert process.returncode == 130 and not (venv / ".demo").exists()
    with pytest.raises(ProcessLookupError):
        os.kill(int((venv / "pid").read_text()), 0)
    monkeypatch.delenv("FAKE_PIP")
    assert set_up("demo", venv).returncode == 0 and (venv / ".demo").exists()


@pytest.mark.parametrize(("output", "expected"), [
    ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "the disk is full; "),
    ("ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE.", "does not match its hash"),
    ("ERROR: Something else\\n\\n[notice] a new release of pip", "installing setuptools: Something else; full output"),
])
def test_failed_pip_gives_one_line_and_no_stamp(stored, venv, monkeypatch, output, expected):
    monkeypatch.setenv("FAKE_PIP", f"printf '{output}'; exit 1")
    done = set_up("demo", venv)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith("error: installing setuptools: ") and expected in line
    assert line.endswith(f"full output in {venv}/setup.log")
    assert output.split("\\n")[0] in (venv / "setup.log").read_text() and not (venv / ".demo").exists()


def test_unreachable_index_gives_one_line(environment, tmp_path):
    setup = environment.Setup("demo", tmp_path)
    setup.python = sys.executable
    with pytest.raises(environment.SetupError, match=r"no answer from the package index; check the network") as caught:
        setup.pip("installing packages", "download", "--no-cache-dir", "--dest", tmp_path, "sightline-robot==0",
                  PIP_INDEX_URL="http://127.0.0.1:9/simple", PIP_EXTRA_INDEX_URL="", PIP_FIND_LINKS="", PIP_RETRIES="0")
    assert len(str(caught.value).splitlines()) == 1 and "127.0.0.1" in (tmp_path / "setup.log").read_text()


def test_disk_without_space_gives_one_line_before_anything_is_written(environment, tmp_path, calls, monkeypatch):
    monkeypatch.setattr(environment.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 123_000_000}))
    with pytest.raises(environment.SetupError, match=r"^123 MB free in .*, the set-up takes \d+ MB: free some space"):
        environment.Setup("demo", tmp_path / "venv").run()
    assert not (tmp_path / "venv").exists()


def without_wheel(environment, monkeypatch):
    monkeypatch.setattr(environment, "has_pybullet_wheel", lambda: False)
    monkeypatch.setattr(environment, "check_compiler", lambda: None)


@pytest.mark.parametrize(("compiler", "expected"), [
    ({"CXX": "/no/such/compiler"}, "no C\\+\\+ compiler"),
    ({"CXX": "sh", "CC": "complain"}, "no headers of Python"),
])
def test_missing_compiler_gives_one_line_before_anything_is_written(environment, tmp_path, calls, monkeypatch, compiler,
                                                                     expected):
    monkeypatch.setattr(environment, "has_pybullet_wheel", lambda: False)
    executable(tmp_path / "complain", "#!/bin/sh\necho 'fatal error: Python.h: No such file' >&2\nexit 1\n")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    for name, value in compiler.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(environment.SetupError, match=f"{expected}.* sudo apt install g\\+\\+ python3-dev"):
        environment.Setup("demo", tmp_path / "venv").run()
    assert not (tmp_path / "venv").exists()


def test_compiled_pybullet_is_stored_and_used_again(environment, venv, tmp_path, calls, monkeypatch, capsys):
    without_wheel(environment, monkeypatch)
    environment.Setup("demo", venv).run()
    output = capsys.readouterr().out
    assert re.search(r"compiling it once, about \d+ min while all \d+ cores are idle; stored in ", output)
    (wheel,) = (tmp_path / "cache").rglob("*.whl")
    numpy = environment.pins(DEMO)["numpy"]
    assert numpy in str(wheel) and f"cp{sys.version_info[0]}{sys.version_info[1]}" in wheel.name
    build = next(line for line in calls.read_text().splitlines() if " wheel " in line)
    assert {"--no-build-isolation", "--require-hashes", "--no-binary"} <= set(build.split())
    calls.unlink()
    # What pip is to install: PyBullet is not to be compiled by pip again.
    copy = f"for word; do case $word in */part*.txt) cat $word > {tmp_path}/${{word##*/}};; esac; done"
    monkeypatch.setenv("FAKE_PIP", copy)
    environment.Setup("test", venv).run()
    parts = [path.read_text() for path in tmp_path.glob("part*.txt")]
    assert len(parts) == 3 and "pybullet" not in "".join(parts)
    entries = [entry for part in parts for entry in environment.entries(part)]
    assert sorted(entries) == sorted(environment.entries(environment.without(ALL.read_text(), "pybullet")))
    text = calls.read_text()
    assert " wheel " not in text and str(wheel) in text and "compiling PyBullet" not in capsys.readouterr().out


def test_failed_compilation_stores_nothing(environment, venv, tmp_path, monkeypatch):
    without_wheel(environment, monkeypatch)
    monkeypatch.setenv("FAKE_BUILD", "1")
    with pytest.raises(environment.SetupError, match="compiling PyBullet"):
        environment.Setup("demo", venv).run()
    assert not list((tmp_path / "cache").rglob("*.*whl*")) and not (venv / ".demo").exists()


def test_long_phase_prints_its_progress(environment, venv, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(environment, "TICK_S", 0.05)
    asked = tmp_path / "asked"
    wait = ["sh", "-c", f"while [ ! -e {asked} ]; do sleep 0.02; done"]
    environment.Setup("demo", venv).phase("compiling", wait, progress=lambda: asked.touch() or "3 of 7 files")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "  compiling ..." and re.fullmatch(r"  compiling: 3 of 7 files, \d+ s", lines[1])
    assert re.fullmatch(r"  compiling: done after \d+ s", lines[-1])


def test_a_failed_command_ends_those_beside_it(environment, venv):
    begin = time.monotonic()
    with pytest.raises(environment.SetupError, match="installing: no such thing; full output in"):
        environment.Setup("demo", venv).phase("installing", ["sleep", "60"],
                                              ["sh", "-c", "echo ERROR: no such thing; exit 3"])
    assert time.monotonic() - begin < 30


def test_commands_run_beside_one_another_and_all_of_them(environment, venv, tmp_path):
    met = f"cd {tmp_path}; touch $0; while [ ! -e $1 ]; do sleep 0.02; done; sleep 0.2; echo $0 >> ended"
    environment.Setup("demo", venv).phase("installing", ["sh", "-c", met, "a", "b"], ["sh", "-c", met, "b", "a"])
    assert sorted((tmp_path / "ended").read_text().split()) == ["a", "b"]


def test_demo_lock_is_a_part_of_the_whole_lock(environment):
    whole = {entry.split("    # via")[0] for entry in environment.entries(ALL.read_text())}
    hashes = {re.sub(r" ;[^\\]*", " ", entry) for entry in whole}
    demo = [entry.split("    # via")[0] for entry in environment.entries(DEMO.read_text())]
    assert len(demo) > 30 and {re.sub(r" ;[^\\]*", " ", entry) for entry in demo} <= hashes
    names = {environment.name_of(entry) for entry in demo}
    assert not names & {"pytest", "mypy", "ruff", "onnx", "hypothesis", "coverage"}
    done = subprocess.run(["make", "--dry-run", "lock"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert re.findall(r"--output-file (\S+)", done.stdout) == [
        "requirements.lock", "requirements-demo.lock", "requirements-docs.lock"]


@pytest.mark.parametrize(("lock", "extra"), [(DEMO, "demo"), (ALL, "dev")])
def test_lock_has_each_requirement_of_its_extra(environment, lock, extra):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras, pins = project["optional-dependencies"], environment.pins(lock)
    waiting, seen = [*project["dependencies"], *extras[extra]], set()
    while waiting:
        wanted = Requirement(waiting.pop())
        if wanted.name == project["name"]:
            waiting += [text for name in wanted.extras - seen for text in extras[name]]
            seen |= wanted.extras
        elif not wanted.marker or wanted.marker.evaluate():
            assert pins[canonicalize_name(wanted.name)] in wanted.specifier, wanted


def test_markers_of_the_locks_are_evaluated_as_packaging_does(environment):
    markers = set(re.findall(r"^\S+ ; (.*?) \\$", ALL.read_text() + DEMO.read_text(), re.MULTILINE))
    assert len(markers) > 5
    assert [marker for marker in markers if environment.applies(marker) != Marker(marker).evaluate()] == []
    assert environment.applies("python_full_version >= '3.9'") and not environment.applies("python_version < '3.9'")


def test_announced_sizes_are_those_of_the_packages(environment):
    """Without what Python compiles, and the disk's blocks."""
    for goal in ("demo", "test"):
        megabytes = 0.0
        for name in [*environment.pins(ROOT / environment.SETS[goal].lock), "pip"]:
            package = importlib.metadata.distribution(name)
            paths = [Path(package.locate_file(file)) for file in package.files if file.suffix != ".pyc"]
            megabytes += sum(path.stat().st_size for path in paths if path.exists()) / 1e6
        assert 0.85 <= megabytes / environment.SETS[goal].installed_mb <= 1.02


def test_first_drive_names_the_size_of_the_environment(environment):
    demo = environment.SETS["demo"]
    page = (ROOT / "docs/tutorials/first-drive.md").read_text("utf-8")
    sizes = f"{demo.ready_made_mb} MB of disk space for the environment, and {demo.download_mb} MB to download"
    assert f"- {sizes}." in page
