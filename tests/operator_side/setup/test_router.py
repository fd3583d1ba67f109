"""`sightline router` as a process: robot and vision meet at it; a busy port and a missing key are one line."""

import itertools
import resource
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, closing, contextmanager

import pytest

from sightline.operator_side.setup import keys, router
from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.protocol.transports.zenoh.session import MAX_ROUTER_SESSIONS, MAX_SESSIONS, open_session
from sightline.robot_side.guardian import stop_forwarder
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint


@contextmanager
def _router(*arguments):
    command = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app", "router", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("secured", [False, True])
def test_robot_and_vision_meet_at_a_router_that_ends_on_a_signal(tmp_path, secured):
    endpoint, secure = free_endpoint(), ""
    if secured:
        secure = str(tmp_path / "keys")
        keys.make(tmp_path / "keys", [])
        endpoint = endpoint.replace("tcp/", "tls/")
    with _router("--listen", endpoint, *(["--secure", secure] if secured else [])) as router:
        assert f" info router: on {endpoint}; " in router.stdout.readline()
        with (
            open_zenoh("r1", connect=[endpoint], role="robot", secure=secure) as robot,
            open_zenoh("r1", connect=[endpoint], role="vision", secure=secure) as vision,
        ):
            frames, twists = vision.latest(FRAME), robot.latest(TWIST)
            assert until(lambda: robot.has_listener(FRAME))
            robot.publish(FRAME, b"{}", b"jpeg")
            assert frames.take(2.0).payload == b"jpeg"
            assert until(lambda: vision.has_listener(TWIST))
            vision.publish(TWIST, b"{}", b"0.1|0")
            assert twists.take(2.0).source == "vision"
            with _router("--listen", endpoint, *(["--secure", secure] if secured else [])) as second:
                assert second.wait(10) == 4
                assert "is in use by" in second.stderr.read()
        router.send_signal(signal.SIGTERM)
        assert router.wait(5) == 0
        assert router.stderr.read() == ""


def test_hung_stop_forwarder_is_killed_and_one_that_reads_is_left_alone(monkeypatch, caplog):
    """The forwarder gets no other packets, so nothing else shows that it hangs."""
    now_s = itertools.count(1000)
    monkeypatch.setattr(router, "monotonic_us", lambda: next(now_s) * 1_000_000)
    with closing(stop_forwarder.start([], "")) as forwarder:
        router._watch(forwarder)
        for _ in range(10):
            assert until(lambda: forwarder._unread_bytes() == 0, START_S)
            router._watch(forwarder)
        running = forwarder._process
        assert running.poll() is None
        running.send_signal(signal.SIGSTOP)
        for _ in range(7):
            router._watch(forwarder)
        assert running.wait(START_S) == -signal.SIGKILL
        router._watch(forwarder)
        assert caplog.messages == ["STOP forwarder ended (stopped or hung); starting it again"]


def test_router_without_its_keys_reports_the_missing_file(tmp_path):
    with _router("--listen", "tls/127.0.0.1:7450", "--secure", str(tmp_path)) as router:
        assert router.wait(10) == 2
        assert router.stderr.read().startswith("error: ca.pem is missing in")


def test_router_does_not_start_where_its_stop_port_would_be_that_of_discovery(monkeypatch):
    monkeypatch.setattr(router, "open_session", lambda *_: pytest.fail("it opened its session"))
    with pytest.raises(ConfigError, match=r"its STOP port would be 7449/udp, .* e\.g\. tcp/0\.0\.0\.0:7449"):
        router.run(["tcp/0.0.0.0:7448"], [], "")


@pytest.mark.slow
def test_a_router_serves_more_sessions_than_a_robot_does():
    endpoint = free_endpoint()
    with _router("--listen", endpoint) as process, ExitStack() as ending:
        assert " on " in process.stdout.readline()
        soft, hard = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        assert soft == resource.RLIM_INFINITY or soft >= min(4 * MAX_ROUTER_SESSIONS, hard)
        for _ in range(MAX_SESSIONS + 4):
            ending.callback(open_session((), [endpoint], 5.0).close)


@pytest.mark.slow
@pytest.mark.waits
def test_clients_that_hang_do_not_keep_a_router_from_serving_the_others():
    """Each close waited for 10 s, in a thread that receives for all sessions."""
    endpoint = free_endpoint()
    subscribe = (f"import time\nfrom {open_session.__module__} import *\n"
                 f"kept = [open_session([], [{endpoint!r}], 5.0) for _ in range(6)]\n"
                 "kept += [one.declare_subscriber('**', print) for one in kept]\nprint(1, flush=True)\ntime.sleep(60)")
    with (
        _router("--listen", endpoint) as router,
        subprocess.Popen([sys.executable, "-c", subscribe], stdout=subprocess.PIPE) as hanging,
        open_zenoh("r1", connect=[endpoint]) as robot,
        open_zenoh("r1", connect=[endpoint]) as vision,
        ExitStack() as ending,
    ):
        ending.callback(hanging.kill)
        assert " on " in router.stdout.readline() and hanging.stdout.read(1)
        frames = vision.latest(FRAME)
        assert until(lambda: robot.has_listener(FRAME))
        time.sleep(1.1)  # the router looks at its connections once a second
        hanging.send_signal(signal.SIGSTOP)
        end_s = time.monotonic() + 5.0
        while time.monotonic() < end_s:
            robot.publish(FRAME, b"{}", b"x" * 10_000)
            assert frames.take(1.0), "a frame passes, also after the lease of 2 s"
            time.sleep(0.03)


@pytest.mark.long
def test_session_beyond_the_limit_of_a_router_gets_the_limit_in_its_error():
    endpoint, (soft, hard) = free_endpoint(), resource.getrlimit(resource.RLIMIT_NOFILE)
    with _router("--listen", endpoint) as process, ExitStack() as ending:
        assert " on " in process.stdout.readline()
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        ending.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(MAX_ROUTER_SESSIONS):
            ending.callback(open_session((), [endpoint], 5.0).close)
        with pytest.raises(LinkError, match=r"has its limit of 64 sessions \(1000 at a router\)"):
            open_session((), [endpoint], 1.0)


@pytest.mark.parametrize(("limits", "expected"), [
    ((1024, 1_048_576), (4000, 1_048_576)), ((1024, 2048), (2048, 2048)), ((8192, 8192), None),
    ((1024, resource.RLIM_INFINITY), (4000, resource.RLIM_INFINITY)),
    ((resource.RLIM_INFINITY, resource.RLIM_INFINITY), None),
])
def test_descriptor_limit_is_raised_and_never_lowered(limits, expected, monkeypatch):
    set_to = []
    monkeypatch.setattr(resource, "getrlimit", lambda _which: limits)
    monkeypatch.setattr(resource, "setrlimit", lambda _which, to: set_to.append(to))
    router._raise_descriptor_limit()
    assert set_to == ([expected] if expected else [])
