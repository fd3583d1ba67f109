"""Requests to a vision for a mission, its reports, and the waypoints of `goto`. Shell (waits).

A file has one waypoint a line, its numbers separated by blanks or a comma; what follows a `#` is a remark.
"""

import re
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

from pydantic import ValidationError

from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.protocol.channels import MISSION, REPORT
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError, LinkError, WireError
from sightline.protocol.messages import (
    MAX_OPTIONS,
    MAX_WAYPOINT_M,
    MAX_WAYPOINTS,
    Echo,
    MissionReport,
    MissionRequest,
    RequestHeader,
    RequestId,
)
from sightline.protocol.transports.link import Link, Message

Waypoints = tuple[tuple[float, float], ...]
_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")


def waypoints_of(texts: Sequence[str]) -> Waypoints:
    """The waypoints of `X Y X Y ...`. Raises ConfigError naming the first that is none."""
    numbers = [_number(text, f"waypoint {at // 2 + 1}") for at, text in enumerate(texts)]
    if len(numbers) % 2:
        raise ConfigError(f"waypoint {len(numbers) // 2 + 1}: has an X and no Y; write X Y [X Y ...] in metres")
    return _counted(tuple(zip(numbers[::2], numbers[1::2], strict=True)))


def waypoints_of_file(text: str, name: str) -> Waypoints:
    """The waypoints of a file's `text`. Raises ConfigError naming file and line."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        parts = line.partition("#")[0].replace(",", " ").split()
        if not parts:
            continue
        if len(parts) != 2:
            raise ConfigError(f"{name}:{number}: has {len(parts)} numbers; write X Y in metres, one waypoint a line")
        found.append((_number(parts[0], f"{name}:{number}"), _number(parts[1], f"{name}:{number}")))
    return _counted(tuple(found))


def _number(text: str, where: str) -> float:
    if not _NUMBER.fullmatch(text):
        raise ConfigError(f"{where}: {text!r} is no number")
    value = float(text)
    if not abs(value) <= MAX_WAYPOINT_M:
        raise ConfigError(f"{where}: {text} m is out of the world; {-MAX_WAYPOINT_M:g} to {MAX_WAYPOINT_M:g} m")
    return value


def _counted(found: Waypoints) -> Waypoints:
    if not 1 <= len(found) <= MAX_WAYPOINTS:
        raise ConfigError(f"{len(found)} waypoints; give 1 to {MAX_WAYPOINTS}, e.g. sightline goto r1 1.5 1.5")
    return found


# Asks a vision for a mission and hears what it does, over any `Link`. Shell (waits).
#
# with open_link("r1", connect=[...], role="operator") as link:
#     MissionClient(link).request("goto", waypoints=((1.5, 1.5),))


REPEAT_S: Final = 0.2
PATIENCE_S: Final = 3.0
"""Six reports long, and a little more than a mission may be old."""
_REPORTER: Final = "vision"


class MissionClient:
    """One person at one robot's vision. Every method that waits is bounded."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.operator = Operator(link)
        self._session = secrets.token_hex(4)
        self._id = self._seq = 0
        self._news = threading.Condition()
        self._report: MissionReport | None = None
        self._heard, self._heard_s = 0, 0.0
        link.subscribe(REPORT, self._on_report)

    def newest(self, timeout_s: float) -> MissionReport | None:
        """The newest report, if one was heard lately or is within `timeout_s`: for display."""
        with self._news:
            self._news.wait_for(self._is_fresh, timeout_s)
            return self._report if self._is_fresh() else None

    def _is_fresh(self) -> bool:
        return self._report is not None and time.monotonic() - self._heard_s < PATIENCE_S

    def report(self, timeout_s: float = PATIENCE_S) -> MissionReport:
        """The next report. Raises LinkError when none comes."""
        return self._next(lambda _report: True, timeout_s)

    def request(self, name: str, waypoints: Waypoints = (), options: Mapping[str, Any] | None = None) -> MissionReport:
        """Ask until vision's report names it; the report's `refused` says whether it was taken up.

        Raises ConfigError for what cannot be asked, LinkError when the robot or its vision does not answer.
        """
        self._id += 1
        request = request_of(self._id, name, waypoints, options or {})
        # Of now: a request that is repeated later is as old as its first sending.
        echo = Echo.of(self.operator.wait_report().stamp)
        mine = RequestId(session=self._session, id=self._id)
        deadline_s = time.monotonic() + PATIENCE_S
        while (left_s := deadline_s - time.monotonic()) > 0:
            self._seq += 1
            header = RequestHeader(source=SOURCE, session=self._session, seq=self._seq, echo=echo)
            self._link.publish(MISSION, encode(header), encode(request), SOURCE)
            try:
                return self._next(lambda report: report.asked == mine, min(REPEAT_S, left_s))
            except LinkError:
                continue
        raise LinkError(self._silence())

    def follow(self, timeout_s: float = PATIENCE_S) -> Iterator[MissionReport]:
        """Every report from now on that says something new of the newest `ask`, until its mission is over.

        Raises LinkError when no report comes within `timeout_s`, or when vision does something else meanwhile.
        """
        mine, said = RequestId(session=self._session, id=self._id), None
        while True:
            report = self.report(timeout_s)
            if report.asked != mine:
                raise LinkError(f"vision was given another mission meanwhile: {report.mission}")
            if report.refused:
                raise LinkError(f"vision does {report.mission} instead: {report.refused}")
            if report != said:
                said = report
                yield report
            if report.done:
                return

    def _next(self, wanted: Callable[[MissionReport], bool], timeout_s: float) -> MissionReport:
        with self._news:
            heard = self._heard
            if not self._news.wait_for(lambda: self._heard > heard and self._is(wanted), timeout_s):
                raise LinkError(self._silence())
            assert self._report is not None
            return self._report

    def _is(self, wanted: Callable[[MissionReport], bool]) -> bool:
        return self._report is not None and wanted(self._report)

    def _silence(self) -> str:
        robot = self._link.robot
        if self._report is None:
            return f"no vision of robot {robot!r} is heard within {PATIENCE_S:g} s; is `sightline vision` running?"
        now = f"{self._report.mission}: {self._report.phase}"
        return f"vision of robot {robot!r} does not answer within {PATIENCE_S:g} s; its last word was {now}"

    def _on_report(self, message: Message) -> None:
        """On the transport's thread: store and return."""
        try:
            report = decode(MissionReport, message.payload, REPORT.max_payload_bytes)
        except WireError:
            return
        if message.source != _REPORTER:
            return
        with self._news:
            self._report = report
            self._heard += 1
            self._heard_s = time.monotonic()
            self._news.notify_all()


def request_of(number: int, name: str, waypoints: Waypoints, options: Mapping[str, Any]) -> MissionRequest:
    """The message. Raises ConfigError for a name, a waypoint or an option that the wire has no room for."""
    try:
        request = MissionRequest(id=number, name=name, waypoints=waypoints, options=dict(options))
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        if first["loc"][0] == "name":
            raise ConfigError(f"{name!r} is no mission's name: lower-case letters, digits and '-'; code of one's own "
                              "(package.module:Name) is named where vision is started") from None
        where = ".".join(str(part) for part in first["loc"][1:2])
        raise ConfigError(f"option {where!r}: true, false, a number or a short text; at most {MAX_OPTIONS} options"
                          ) from None
    if len(encode(request)) > MISSION.max_payload_bytes:
        raise ConfigError(f"the mission takes more than {MISSION.max_payload_bytes} bytes; give fewer waypoints")
    return request


# What vision reports of itself, in words. Pure.


def mission_line(report: MissionReport) -> str:
    """One line: the mission, its phase, the rest."""
    return "".join([f"{report.mission}: {report.phase}", f"; {report.note}" if report.note else "",
                    " (over)" if report.done else ""])


def mission_lines(report: MissionReport) -> Iterator[str]:
    """For `sightline status`, in its columns."""
    yield f"mission   {mission_line(report)}"
    if report.refused:
        yield f"          the last that was asked for is not taken up: {report.refused}"
    if report.detector:
        yield f"detector  {detector_line(report)}"


def detector_line(report: MissionReport) -> str:
    """Who looks, on what, how fast."""
    parts = [report.detector, f"on {report.device}" if report.device else "", f"model {report.model}" if report.model
             else "", f"{report.inference_us / 1000:.1f} ms a picture" if report.inference_us is not None else ""]
    return ", ".join(part for part in parts if part)


def cannot(report: MissionReport) -> bool:
    """Whether a mission is over because it could not be done."""
    return report.done and (report.phase in ("failed", "cannot reach") or report.note.startswith("cannot"))
