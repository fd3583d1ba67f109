"""Set up the environment of `make demo` or `make test`: packages, PyBullet and Sightline itself in one folder.

The Makefile calls it before each goal. It returns at once where the environment is ready. Standard library only.
"""

import argparse
import hashlib
import json
import math
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent
TICK_S = 10.0
POLL_S = 0.05
MIN_PYTHON = (3, 11)


@dataclass(frozen=True)
class PackageSet:
    """The packages of a goal, with sizes measured on Linux x86_64 (tests/repository/test_environment.py)."""

    lock: str
    purpose: str
    ready_made_mb: int
    download_mb: int

    @property
    def installed_mb(self) -> int:
        """The size on this Python: a PyBullet that is compiled here lacks the debug symbols of the ready-made one."""
        return self.ready_made_mb - (0 if has_pybullet_wheel() else DEBUG_SYMBOLS_MB)


SETS = {
    "demo": PackageSet("requirements-demo.lock", "what a demo imports", 890, 290),
    "test": PackageSet("requirements.lock", "a demo, the tests and the linters", 1145, 365),
}
DEBUG_SYMBOLS_MB = 125
# What the compilation of PyBullet writes below TMPDIR, and the CPU time that it takes (measured with Python 3.12).
BUILD_MB = 500
BUILD_CPU_MINUTES = 5.4
BUILD_OBJECTS = 267
# pip unpacks on one core. The lock is complete, so that no part needs what another one installs.
PIPS = 2
# Python's own flags add debug symbols and warnings, which only cost time and space.
BUILD_FLAGS = "-O2 -g0 -w"
# Below it a log may lack the line that names the cause.
FULL_BYTES = 1_000_000
DISK_FULL = "the disk is full; free some space and repeat"


class SetupError(Exception):
    """The set-up cannot go on. The text is one line with the fix."""


class Setup:
    """One run of the set-up of `goal` in the folder `venv`."""

    def __init__(self, goal: str, venv: Path) -> None:
        self.goal, self.venv = goal, venv
        self.python = venv / "bin/python"
        self.log = venv / "setup.log"
        self.wanted = SETS[goal]
        self.lock = ROOT / self.wanted.lock
        self.stamp = venv / f".{goal}"

    def run(self) -> None:
        """Bring the environment up to date, or raise SetupError. Writes the stamp only after the last step."""
        self.check_python()
        digest = self.digest()
        if self.stamp.is_file() and self.stamp.read_text() == digest and self.is_editable():
            return
        compiles = not has_pybullet_wheel()
        wheel = stored_wheel(self.lock)
        builds = compiles and not wheel.is_file()
        if builds:
            check_compiler()
        packages = len(pins(self.lock))
        print(f"setting up {self.venv} for `make {self.goal}`: {packages} packages ({self.wanted.purpose}), "
              f"{self.wanted.installed_mb} MB installed, {self.wanted.download_mb} MB to download if not in the cache",
              flush=True)
        self.check_space(BUILD_MB if builds else 0)
        self.create()
        self.log.unlink(missing_ok=True)
        if builds:
            self.build_pybullet(wheel)
        self.install(wheel if compiles else None)
        self.stamp.write_text(digest)

    def check_python(self) -> None:
        """Raise SetupError where `venv` belongs to another Python than this one, or to one that is gone."""
        if not (self.venv / "pyvenv.cfg").exists():
            if self.venv.is_dir() and any(self.venv.iterdir()):
                raise SetupError(f"{self.venv} is not a Python environment: move it away, or pass VENV=ANOTHER_FOLDER")
            return
        try:
            command = [self.python, "-c", "import sys; print('%d.%d.%d' % sys.version_info[:3])"]
            found = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()
        except (OSError, subprocess.SubprocessError):
            raise SetupError(f"the Python of {self.venv} is gone: run `make clean`, then `make {self.goal}`") from None
        own = "{}.{}.{}".format(*sys.version_info[:3])
        if found.split(".")[:2] != own.split(".")[:2]:
            raise SetupError(f"{self.venv} has Python {found}, but PYTHON is {own}: run `make clean`, then "
                             f"`make {self.goal}`, or pass PYTHON=python{'.'.join(found.split('.')[:2])}")

    def digest(self) -> str:
        """Digest of all that decides what is installed."""
        facts = hashlib.sha256(f"{sys.version} {ROOT}".encode())
        for path in (self.lock, ROOT / "pyproject.toml", ROOT / "setup.py"):
            facts.update(path.read_bytes())
        return facts.hexdigest()

    def is_editable(self) -> bool:
        """Return True if Sightline runs from this folder. `pip install '.[extra]'` puts a copy in its place."""
        records = self.venv.glob("lib/python*/site-packages/sightline_robot-*.dist-info/direct_url.json")
        return any(json.loads(one.read_text()).get("dir_info", {}).get("editable") for one in records)

    def check_space(self, build_mb: int) -> None:
        """Raise SetupError where a disk has less space than the set-up takes."""
        present_mb = max((SETS[goal].installed_mb for goal in SETS if (self.venv / f".{goal}").exists()), default=0)
        venv_mb, temporary_mb = max(self.wanted.installed_mb - present_mb, 20), self.wanted.download_mb + build_mb
        folder = next(path for path in (self.venv.absolute(), *self.venv.absolute().parents) if path.is_dir())
        temporary = Path(tempfile.gettempdir())
        needs = {folder: venv_mb, temporary: temporary_mb}
        if folder.stat().st_dev == temporary.stat().st_dev:
            needs = {folder: venv_mb + temporary_mb}
        for path, needed_mb in needs.items():
            free_mb = shutil.disk_usage(path).free // 1_000_000
            if free_mb < needed_mb:
                raise SetupError(f"{free_mb} MB free in {path}, the set-up takes {needed_mb} MB: free some space, or "
                                 "pass VENV=/another/disk/venv and TMPDIR=/another/disk")

    def create(self) -> None:
        """Make the environment, or complete one whose making was interrupted."""
        if self.python.exists() and not subprocess.run([self.python, "-c", "import pip"], capture_output=True,
                                                       check=False).returncode:
            return
        done = subprocess.run([sys.executable, "-m", "venv", self.venv], capture_output=True, text=True, check=False)
        if done.returncode:
            missing = "ensurepip" in done.stdout + done.stderr
            raise SetupError("this Python cannot make environments: sudo apt install python3-venv" if missing else
                             f"cannot make {self.venv}: {last_line(done.stdout + done.stderr)}")

    def install(self, wheel: Path | None) -> None:
        """Install the locked packages and Sightline itself, editable, and compile the tests once."""
        with tempfile.TemporaryDirectory(prefix="sightline-") as folder:
            pinned = list(entries(without(self.lock.read_text(), "pybullet") if wheel else self.lock.read_text()))
            # By itself, because one pip must not replace it while another one builds a package with it.
            first = [entry for entry in pinned if name_of(entry) == "setuptools"]
            others = [entry for entry in pinned if entry not in first]
            parts = [Path(folder) / f"part{number}.txt" for number in range(1 + PIPS)]
            for part, chosen in zip(parts, (first, *(others[number::PIPS] for number in range(PIPS))), strict=True):
                part.write_text("".join(chosen))
            setuptools, *pips = (
                self.pip_command("install", "--require-hashes", "--no-deps", "--no-compile", "-r", part)
                for part in parts)
            self.phase("installing setuptools", setuptools)
            self.phase("installing packages", *pips, progress=self.installed)
            if wheel:
                self.pip("installing PyBullet", "install", "--no-deps", "--no-index", "--no-compile", wheel)
            # Metadata and build files of the package belong to neither the checkout nor an earlier build.
            config = Path(folder) / "build.cfg"
            config.write_text(f"[build]\nbuild_base = {folder}/build\n[egg_info]\negg_base = {folder}\n")
            self.pip("installing Sightline", "install", "--no-deps", "--no-build-isolation", "--no-index",
                     "--editable", ROOT, DIST_EXTRA_CONFIG=str(config))
        if self.goal == "test":
            with suppress(SetupError):  # a test that cannot be imported is reported by the tests
                self.phase("compiling the tests", [self.python, "-m", "pytest", "--collect-only", "-q", "-m", ""])

    def installed(self) -> str:
        """Count the packages that are installed so far."""
        ready = len(list(self.venv.glob("lib/python*/site-packages/*.dist-info")))
        return f"{ready} of {len(pins(self.lock)) + 1} packages"

    def build_pybullet(self, wheel: Path) -> None:
        """Compile PyBullet's locked source with the locked NumPy present, and store the wheel for later set-ups."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        minutes = math.ceil(BUILD_CPU_MINUTES / cores)
        print(f"PyBullet has no ready-made package for Python {sys.version_info[0]}.{sys.version_info[1]} here: "
              f"compiling it once, about {minutes} min while all {cores} cores are idle; stored in {wheel.parent}",
              flush=True)
        wheel.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="sightline-build-") as folder:
            needs, source = Path(folder) / "needs.txt", Path(folder) / "source.txt"
            text = self.lock.read_text()
            needs.write_text("".join(entry for entry in entries(text) if name_of(entry) in ("numpy", "setuptools")))
            source.write_text("".join(entry for entry in entries(text) if name_of(entry) == "pybullet"))
            self.pip("installing NumPy for the compilation", "install", "--require-hashes", "--no-compile", "-r", needs)
            # --use-pep517: old pip would call setup.py itself, and need the package wheel.
            self.pip("compiling PyBullet", "wheel", "--no-deps", "--no-build-isolation", "--use-pep517",
                     "--no-binary", "pybullet", "--require-hashes", "-r", source, "--wheel-dir", Path(folder) / "built",
                     progress=lambda: objects_in(Path(folder)), TMPDIR=folder, CFLAGS=BUILD_FLAGS, CXXFLAGS=BUILD_FLAGS)
            (built,) = (Path(folder) / "built").glob("*.whl")
            part = wheel.with_name(f"{built.name}.{os.getpid()}.part")
            shutil.copyfile(built, part)
            part.replace(wheel)

    def pip(self, label: str, *words: Any, progress: Callable[[], str] = str, **environ: str) -> None:
        """Run pip with `words` as one phase."""
        self.phase(label, self.pip_command(*words), progress=progress, environ=environ)

    def pip_command(self, *words: Any) -> list[Any]:
        """Return the command that runs pip with `words`."""
        return [self.python, "-m", "pip", "--disable-pip-version-check", "--no-input", *words]

    def phase(self, label: str, *commands: list[Any], progress: Callable[[], str] = str,
              environ: dict[str, str] | None = None) -> None:
        """Run `commands` beside one another, with their output in the log, until all have ended or one has failed.
        Print a line when they begin, every ten seconds and at their end.

        Raises:
            SetupError: a command failed; the line names cause, fix and log.
        """
        begin, begin_of_output = time.monotonic(), self.log.stat().st_size if self.log.exists() else 0
        print(f"  {label} ...", flush=True)
        try:
            with self.log.open("a+b") as log, ExitStack() as running:
                processes = [running.enter_context(started([str(word) for word in command], log, environ or {}))
                             for command in commands]
                while (code := waited(processes, TICK_S)) is None:
                    print(f"  {label}: {', '.join(filter(None, (progress(), elapsed(begin))))}", flush=True)
                log.seek(begin_of_output)
                output = log.read().decode(errors="replace")
        except OSError as error:
            raise SetupError(f"{label}: {error.strerror}: {self.log}") from None
        if code:
            full = shutil.disk_usage(self.venv).free < FULL_BYTES
            raise SetupError(f"{label}: {DISK_FULL if full else cause(output)}; full output in {self.log}")
        print(f"  {label}: done after {elapsed(begin)}", flush=True)


def has_pybullet_wheel() -> bool:
    """PyBullet 3.2.7 has packages for Linux x86_64 with glibc up to Python 3.11; elsewhere it is compiled."""
    glibc = "CS_GNU_LIBC_VERSION" in getattr(os, "confstr_names", {})
    return sys.version_info[:2] == MIN_PYTHON and glibc and sysconfig.get_platform() == "linux-x86_64"


def stored_wheel(lock: Path) -> Path:
    """Name the file of the compiled PyBullet: one for each version, Python, NumPy and flags."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    python = f"cp{sys.version_info[0]}{sys.version_info[1]}"
    system = re.sub(r"[^a-z0-9]", "_", sysconfig.get_platform())
    locked = pins(lock)
    folder = cache / "sightline/wheels" / f"numpy-{locked['numpy']}{BUILD_FLAGS.replace(' ', '')}"
    return folder / f"pybullet-{locked['pybullet']}-{python}-{python}-{system}.whl"


def check_compiler() -> None:
    """Raise SetupError where no C++ compiler or no headers of Python are found."""
    compiler = (os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc").split()[0]
    linker = (os.environ.get("CXX") or sysconfig.get_config_var("CXX") or "c++").split()[0]
    source = "#include <Python.h>\n#include <vector>\n"
    command = [compiler, "-x", "c++", "-fsyntax-only", f"-I{sysconfig.get_path('include')}", "-"]
    reason = f"PyBullet has no ready-made package for Python {sys.version_info[0]}.{sys.version_info[1]} here"
    fix = "sudo apt install g++ python3-dev, or use Python 3.11 on x86_64, or docker compose up"
    try:
        if not shutil.which(linker):
            raise FileNotFoundError
        done = subprocess.run(command, input=source, capture_output=True, text=True, check=False)
    except OSError:
        raise SetupError(f"{reason}, and no C++ compiler ({linker}) to compile it: {fix}") from None
    if done.returncode:
        part = "headers of Python (Python.h)" if "Python.h" in done.stderr else f"working C++ compiler ({compiler})"
        raise SetupError(f"{reason}, and no {part} to compile it: {fix}")


def entries(lock: str) -> Iterator[str]:
    """Split a lock into one text for each pin, with its hashes."""
    yield from re.findall(r"^[A-Za-z0-9][^\n]*\n(?:[ #][^\n]*\n)*", lock, re.MULTILINE)


def name_of(entry: str) -> str:
    """Read the package's name from an entry of a lock."""
    return entry.partition("==")[0].strip()


def without(lock: str, name: str) -> str:
    """Leave one package out of a lock."""
    return "".join(entry for entry in entries(lock) if name_of(entry) != name)


def pins(lock: Path) -> dict[str, str]:
    """Read name and version of each package that the lock has for this Python on this system."""
    found = {}
    for entry in entries(lock.read_text()):
        pin, _, marker = entry.splitlines()[0].rstrip("\\ ").partition(" ; ")
        if applies(marker):
            name, _, version = pin.partition("==")
            found[name] = version
    return found


class Version(str):
    """A version of Python in a marker, compared number by number."""

    __slots__ = ()

    def __lt__(self, other: str) -> bool:
        return numbers(self) < numbers(other)

    def __ge__(self, other: str) -> bool:
        return not self < other

    def __gt__(self, other: str) -> bool:
        return numbers(self) > numbers(other)

    def __le__(self, other: str) -> bool:
        return not self > other


def numbers(version: str) -> list[int]:
    """Split a version into its numbers."""
    return [int(number) for number in version.split(".")]


def applies(marker: str) -> bool:
    """Evaluate an environment marker of the lock, whose syntax is Python's. Not every Python brings `packaging`."""
    values = {
        "python_version": Version(".".join(map(str, sys.version_info[:2]))),
        "python_full_version": Version(".".join(map(str, sys.version_info[:3]))),
        "implementation_name": sys.implementation.name,
        "platform_python_implementation": platform.python_implementation(),
        "platform_machine": platform.machine(),
        "platform_system": platform.system(),
        "sys_platform": sys.platform,
        "os_name": os.name,
    }
    return not marker or bool(eval(marker, {"__builtins__": {}}, values))


def objects_in(folder: Path) -> str:
    """Count the object files that the compiler wrote so far."""
    return f"{sum(1 for _ in folder.rglob('*.o'))} of {BUILD_OBJECTS} files"


@contextmanager
def started(command: list[str], log: Any, environ: dict[str, str]) -> Iterator["subprocess.Popen[bytes]"]:
    """Start a command with its own process group, which ends with this program, however that ends."""
    arrived: list[int] = []
    handlers = {number: signal.signal(number, lambda number, _: arrived.append(number))
                for number in (signal.SIGINT, signal.SIGTERM)}
    process = None
    try:
        # A signal between fork and assignment would leave a process that nothing ends.
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                                   env=os.environ | environ, start_new_session=True)
        restore(handlers)
        if arrived:
            raise KeyboardInterrupt
        yield process
    finally:
        restore(handlers)
        if process and process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()


def restore(handlers: dict[signal.Signals, Any]) -> None:
    """Install the handlers of before."""
    for number, handler in handlers.items():
        signal.signal(number, handler)


def waited(processes: "list[subprocess.Popen[bytes]]", seconds: float) -> int | None:
    """Wait until all have ended or one has failed: the exit code of that one, or 0; None after `seconds`."""
    end = time.monotonic() + seconds
    while True:
        codes = [process.poll() for process in processes]
        failed = next(filter(None, codes), None)
        if failed or None not in codes:
            return failed or 0
        if time.monotonic() > end:
            return None
        time.sleep(POLL_S)


def cause(log: str) -> str:
    """Name cause and fix of a failed pip in one line."""
    for pattern, line in (
        (r"No space left on device|\[Errno 28\]|Disk quota exceeded", DISK_FULL),
        (r"DO NOT MATCH THE HASHES", "a download does not match its hash in the lock; clear it with `pip cache purge`"),
        (r"NewConnectionError|Connection refused|name resolution|Name or service not known|Network is unreachable|"
         r"[Cc]onnect(ion)? ?[Tt]ime|Read timed out|ProxyError|SSLError|Connection ?(broken|aborted|reset)|"
         r"from versions: none", "no answer from the package index; check the network and repeat"),
        (r"fatal error|internal compiler error|Killed signal", "the compiler failed"),
    ):
        if re.search(pattern, log):
            return line
    return last_line("\n".join(re.findall(r"^ *(?:ERROR|error): .*", log, re.MULTILINE)) or log)


def last_line(text: str) -> str:
    """Take the last line of an output, without pip's label."""
    lines = [line.strip() for line in text.splitlines() if line.strip()] or ["no output"]
    return re.sub(r"^(ERROR|error): ", "", lines[-1])


def elapsed(begin: float) -> str:
    """Write the time since `begin`."""
    minutes, seconds = divmod(round(time.monotonic() - begin), 60)
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"


def main() -> int:
    """Set up; print one line where that fails. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("goal", choices=SETS)
    parser.add_argument("venv", type=Path)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        Setup(options.goal, options.venv).run()
    except SetupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"error: interrupted; run `make {options.goal}` again to go on", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"error: {error.strerror} ({error.filename}): free some space or pass VENV=FOLDER", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
