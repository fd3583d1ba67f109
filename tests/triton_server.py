"""A real Triton server on the CPU, for tests: from the wheel `nvidia-pytriton`, its `tritonserver` started as it is.

The wheel is unpacked once into a folder of its own, without what it depends on: the server is one program. Its Python
backend needs a NumPy before 2 (with a later one it reads and writes other bytes than it is given), and looks at no
PYTHONPATH: NumPy and OpenCV lie in the same folder, and it finds them by links beside itself.
"""

import contextlib
import ctypes
import http.client
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

from tests.link_rigs import free_endpoint

ROOT = Path(__file__).parent.parent
FOLDER = Path(os.environ.get("TRITON_TEST_DIR", ROOT / ".venv" / "triton"))
WHEELS = ("nvidia-pytriton==0.7.0", "numpy==1.26.4", "opencv-python-headless==4.11.0.86")
MODELS = ROOT / "examples" / "triton" / "models"
READY_S, INSTALL_S = 60.0, 300
VERSION = f"{sys.version_info[0]}.{sys.version_info[1]}"
LENT = ("numpy", "numpy.libs", "cv2", "opencv_python_headless.libs")


def why_impossible():
    """Why there can be no Triton server here; empty if there can."""
    if sys.platform != "linux" or platform.machine() != "x86_64" or not (3, 8) <= sys.version_info[:2] <= (3, 13):
        return "the wheel is for Linux on x86_64 and Python 3.8 to 3.13"
    library = f"libpython{VERSION}.so.1.0"
    try:
        ctypes.CDLL(library)
    except OSError:
        return f"its Python backend needs {library}: apt-get install libpython{VERSION}"
    if not all((FOLDER / name).exists() for name in ("pytriton", *LENT)):
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(FOLDER), *WHEELS]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_S, check=False)
        except subprocess.TimeoutExpired:
            return f"{WHEELS[0]} was not installed within {INSTALL_S} s"
        if done.returncode != 0:
            return f"{WHEELS[0]} cannot be installed: {done.stderr.strip().splitlines()[-1:]}"
    return ""


def _make_ready(tree):
    """The backend for this Python, and what it is lent."""
    backend = tree / "backends" / "python"
    stub = tree / "python_backend_stubs" / VERSION / "triton_python_backend_stub"
    for path in (stub, *(FOLDER / name for name in LENT)):
        link = backend / path.name
        if link.is_symlink() and not link.exists():
            link.unlink()
        if not link.exists():
            link.symlink_to(path.resolve())
    for program in (tree / "bin" / "tritonserver", stub):
        program.chmod(0o755)


class TritonServer:
    """Serves `models` on loopback; use it in a `with`. `kill` and `start` may be repeated."""

    def __init__(self, folder, models=MODELS):
        self.http, self.grpc = (int(free_endpoint().rpartition(":")[2]) for _ in range(2))
        self._models, self._log = models, Path(folder) / "triton.log"
        self._process = None

    def start(self, wait=True):
        tree = FOLDER / "pytriton" / "tritonserver"
        _make_ready(tree)
        env = {**os.environ, "LD_LIBRARY_PATH": str(FOLDER / "nvidia_pytriton.libs")}
        command = [str(tree / "bin" / "tritonserver"), f"--model-repository={self._models}",
                   f"--backend-directory={tree / 'backends'}", f"--http-port={self.http}",
                   f"--grpc-port={self.grpc}", "--http-address=127.0.0.1", "--grpc-address=127.0.0.1",
                   "--allow-metrics=false", "--exit-timeout-secs=2"]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(command, env=env, stdout=log, stderr=log, start_new_session=True)
        if wait:
            self.wait_ready()

    def wait_ready(self):
        deadline_s = time.monotonic() + READY_S
        while not self._ready():
            assert self._process.poll() is None, self._log.read_text()[-2000:]
            assert time.monotonic() < deadline_s, self._log.read_text()[-2000:]
            time.sleep(0.05)

    def _ready(self):
        connection = http.client.HTTPConnection("127.0.0.1", self.http, timeout=1)
        with contextlib.closing(connection):
            try:
                connection.request("GET", "/v2/health/ready")
                return connection.getresponse().status == 200
            except OSError:
                return False

    def kill(self):
        """At once, with its backend: nothing is said to clients."""
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, 9)
            self._process.wait()
            self._process = None

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.kill()
