"""Peers on sockets of loopback, honest or with one fault, and the kit that connects to them. Shell (sockets, time)."""

import threading
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from sightline.conformance.benches import FROM_ROBOT, TO_ROBOT, LiveBench
from sightline.conformance.case import Access
from sightline.conformance.robot.cases import prepare
from sightline.protocol.transports.open import open_link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving.process import serve
from tests.conformance.robot.broken.websocket import BEHIND_TOKENS, DEFECTS
from tests.conformance.robot.small_server import STOP_SECRET, SmallServer
from tests.conformance.vision.sockets import SocketVision
from tests.fixtures.javascript import EXAMPLES, JsRobot, JsVision
from tests.fixtures.ports import free_endpoint

TOKENS = {"vision": "vision-0123456789abcdef", "operator": "operator-0123456789abcdef"}
VISION_TOKEN = "0123456789abcdefABCDEF_-"
DEFECTS_BEHIND_TOKENS = frozenset(DEFECTS[name] for name in BEHIND_TOKENS)


@contextmanager
def kit_at(endpoint, older="", folder="", robot="r1"):
    """The kit connected to a robot; with a `folder` of keys it connects with those."""
    tokens = {role: (Path(folder) / f"{role}.token").read_text().strip() for role in TOKENS} if folder else {}

    def open_it(role):
        return open_link(robot, connect=[endpoint], role=role, timeout_s=20, secure=folder)

    roles = tuple(TOKENS) if folder else ("vision",)
    options = {"roles": roles, "endpoint": endpoint, "legacy": older, "access": Access(tokens, folder)}
    with LiveBench(robot, open_it, FROM_ROBOT, **options) as bench:
        yield bench, prepare


@contextmanager
def small_server(defect="", guarded=None):
    """The kit at a small server; `guarded`: with tokens, by default where the defect shows only then."""
    guarded = defect in DEFECTS_BEHIND_TOKENS if guarded is None else guarded
    with TemporaryDirectory() as folder, SmallServer({defect} if defect else (), TOKENS if guarded else None) as server:
        for role, token in TOKENS.items():
            (Path(folder) / f"{role}.token").write_text(token)
        (Path(folder) / "stop.secret").write_bytes(STOP_SECRET)
        with kit_at(server.endpoint, server.older, folder if guarded else "") as kit:
            yield kit


@contextmanager
def javascript_robot(folder=EXAMPLES):
    """The kit at the JavaScript robot whose modules lie in `folder`."""
    with ExitStack() as ending:
        state = Path(ending.enter_context(TemporaryDirectory()))
        robot = ending.enter_context(JsRobot(state, "--guests", source=folder))
        yield ending.enter_context(kit_at(robot.endpoint, robot="js1"))


@contextmanager
def played_robot(vision):
    """The kit listens, and `vision(endpoint)`, a context, connects; the kit checks a token but requires none."""
    endpoint = free_endpoint("ws://")

    def open_it(role):
        return open_link("r1", listen=[endpoint], role=role)

    options = {"roles": ("robot",), "endpoint": endpoint, "access": Access({"vision": VISION_TOKEN})}
    with LiveBench("r1", open_it, TO_ROBOT, **options) as bench, vision(endpoint):
        yield bench, _no_preparation


def _no_preparation(_bench):
    """The cases with sockets of their own wait for the vision service themselves."""


def plain_vision(endpoint, broken=""):
    """A vision service over the library `websockets`; `broken` is a case's id, or empty."""
    return SocketVision(endpoint, broken, VISION_TOKEN)


@contextmanager
def our_vision(endpoint):
    """The service as the command runs it, in a thread."""
    ending = threading.Event()
    with _folder_of(VISION_TOKEN) as folder, open_link("r1", connect=[endpoint], role="vision", secure=folder) as link:
        running = threading.Thread(target=serve, args=(VisionConfig(), link, ending, lambda line: None), daemon=True)
        running.start()
        yield
        ending.set()
        running.join(2)


@contextmanager
def javascript_vision(endpoint, folder=EXAMPLES):
    """The JavaScript vision service whose modules lie in `folder`."""
    with ExitStack() as ending:
        keys = ending.enter_context(_folder_of(VISION_TOKEN))
        token = str(Path(keys) / "vision.token")
        ending.enter_context(JsVision(Path(keys), endpoint, "r1", "--token-file", token, source=folder))
        yield


@contextmanager
def _folder_of(token):
    with TemporaryDirectory() as folder:
        (Path(folder) / "vision.token").write_text(token)
        yield folder
