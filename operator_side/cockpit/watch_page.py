"""The page of `sightline watch`: image, state and reasons of a robot. Shell (threads)."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sightline.operator_side.client.missions import MissionClient, detector_line, mission_line
from sightline.operator_side.client.pictures import Pictures
from sightline.operator_side.client.status import drops_text, encoding_text, millis, rejections_text, twist_text
from sightline.operator_side.cockpit.frame_buffer import FrameBuffer, fill
from sightline.operator_side.cockpit.http_server import HttpAnswer, PageRequest, as_json, page, served
from sightline.protocol.channels import Channel
from sightline.protocol.messages import Status
from sightline.protocol.transports.link import Link

_SHOWN_PICTURES = 2  # the newest image, and the one before for a second page


@contextmanager
def watch_page(link: Link, role: str, first: Channel, port: int, secure: str) -> Iterator[str]:
    """Serve the page in this context. Yields its address. Raises LinkError for a port in use."""
    pictures, missions, ending = Pictures(link, role, first, secure), MissionClient(link), threading.Event()
    buffer = FrameBuffer(_SHOWN_PICTURES, pictures.age_us)

    def state(_request: PageRequest, _body: bytes) -> HttpAnswer:
        return as_json(state_of(link.robot, missions, pictures.is_online))

    routes = {
        "GET /": lambda _request, _body: page("watch.html", robot=link.robot),
        "GET /watch.mjs": lambda _request, _body: page("watch.mjs"),
        "GET /picture": buffer.route,
        "GET /state": state,
    }
    filling = threading.Thread(target=fill, args=(buffer, pictures, ending), name="pictures", daemon=True)
    with served(routes, port) as address:
        filling.start()
        try:
            yield address
        finally:
            ending.set()
            filling.join(2.0)


def state_of(robot: str, missions: MissionClient, is_online: bool) -> dict[str, Any]:
    """Return the text next to the image. Without `is_online` it is empty, because the state is unknown."""
    report = missions.operator.report if is_online else None
    lines = _robot_lines(report.status) if report is not None else []
    mission = missions.newest(0.0) if is_online else None
    if mission is not None:
        lines.insert(0, ("mission", mission_line(mission)))
        if mission.detector:
            lines.append(("detector", detector_line(mission)))
    return {
        "robot": robot, "online": is_online, "state": str(report.status.state) if report else "",
        "reason": report.status.reason if report else "", "lines": lines,
    }


def _robot_lines(status: Status) -> list[tuple[str, str]]:
    stream = status.stream
    driver = f"{status.holder.source} {status.holder.digest}" if status.holder else "none"
    age = f"{millis(status.frame_age_us)} old, capture to command {millis(status.latency_us)}"
    return [
        ("driver", driver),
        ("wheels", twist_text(status.applied)),
        ("frame age", age if status.frame_age_us is not None else "no command in force"),
        ("stream", f"{stream.fps:.0f} frames per second, encoding {encoding_text(stream)}"),
        ("dropped", drops_text(stream)),
        ("commands", f"{status.accepted} accepted, {rejections_text(status)}"),
    ]
