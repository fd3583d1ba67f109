"""`.ci/engine` where no engine can be had: exit code 3, why in one line, nothing left running. Stand-ins on PATH."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
TOOLS = ("bash", "sed", "head", "tail", "dirname", "grep", "mkdir", "mktemp", "seq", "sleep", "setsid", "timeout", "rm",
         "chmod", "cat", "python3")
MOUNTS = "cgroup2 /sys/fs/cgroup cgroup2 rw 0 0\n"
NO_ENGINE = {"docker": "exit 1", "dockerd": "exit 1", "iptables": "", "docker-compose": ""}
PULLS_NOTHING = 'case "$1" in version) exit 0;; *) exit 1;; esac'


@pytest.fixture
def engine(tmp_path):
    """Runs `.ci/engine up` of a copy with `stand_ins` (name -> its shell text) and a few real tools, nothing else."""
    (tmp_path / ".ci").mkdir()
    script = (ROOT / ".ci" / "engine").read_text()
    for place in ("/var/lib/", "/run/", "/var/log/", "/proc/mounts", "/usr/sbin/policy-rc.d"):
        assert place in script
        script = script.replace(place, f"{tmp_path}/{place.strip('/').replace('/', '-')}")
    (tmp_path / ".ci" / "engine").write_text(script)
    shutil.copy(ROOT / "Dockerfile", tmp_path)
    (tmp_path / "bin").mkdir()
    for tool in TOOLS:
        (tmp_path / "bin" / tool).symlink_to(shutil.which(tool))

    def up(stand_ins, uid=0, mounts=MOUNTS):
        (tmp_path / "proc-mounts").write_text(mounts)
        for name, text in {"id": f"echo {uid}", **stand_ins}.items():
            (tmp_path / "bin" / name).write_text(f"#!{shutil.which('bash')}\n{text}\n")
            (tmp_path / "bin" / name).chmod(0o755)
        return subprocess.run([shutil.which("bash"), str(tmp_path / ".ci" / "engine"), "up"], capture_output=True,
                              text=True, timeout=30, check=False, env={"PATH": str(tmp_path / "bin")})

    return up


@pytest.mark.parametrize(("stand_ins", "changes", "why"), [
    ({"docker": "exit 1"}, {"uid": 1000}, "none answers with docker-compose beside it, and starting one takes root"),
    ({"docker": "exit 1"}, {}, "docker.io iptables docker-compose not installed, and there is no apt-get"),
    ({"docker": "exit 1", "apt-get": "exit 100"}, {},
     "apt-get install docker.io iptables docker-compose failed; is there a network?"),
    ({"docker": PULLS_NOTHING}, {}, "docker-compose not installed, and there is no apt-get"),
    (NO_ENGINE, {"mounts": "tmpfs /sys/fs/cgroup tmpfs rw 0 0\n"}, "no cgroups are mounted"),
    ({**NO_ENGINE, "dockerd": "echo 'failed to start daemon: not permitted' >&2; exit 1"}, {},
     "dockerd: failed to start daemon: not permitted"),
    ({"docker": PULLS_NOTHING, "docker-compose": "", "apt-get": "exit 100"}, {},
     "python:3.11-slim-bookworm cannot be pulled, and debootstrap not installed"),
    ({"docker": PULLS_NOTHING, "docker-compose": "", "debootstrap": "echo 'E: no mirror'; exit 1"}, {},
     "debootstrap: E: no mirror; is there a network?"),
])  # fmt: skip
def test_missing_engine_prints_the_reason_in_the_last_line(engine, stand_ins, changes, why):
    done = engine(stand_ins, **changes)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (3, f"no engine: {why}"), done


def test_running_engine_with_its_base_image_is_unchanged(engine):
    done = engine({"docker": "exit 0", "docker-compose": ""}, uid=1000)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
