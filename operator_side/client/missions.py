"""Mission requests to a vision service, its reports, and the waypoints of `goto`. Shell (waits).

A waypoint file has one waypoint per line: two numbers separated by spaces or a comma. A `#` starts a comment.
"""

import re
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

from pydantic import ValidationError

from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.operator_side.client.status import counts_text
from sightline.protocol.channels import MISSION, REPORT
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError, LinkError, WireError
from sightline.protocol.log import printable
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
from sightline.protocol.proof import session_digest
from sightline.protocol.transports.link import Link, Message

Waypoints = tuple[tuple[float, float], ...]
_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")


def waypoints_of(texts: Sequence[str]) -> Waypoints:
    """Parse waypoints from `X Y X Y ...`. Raises ConfigError that names the first invalid waypoint."""
    numbers = [_number(text, f"waypoint {at // 2 + 1}") for at, text in enumerate(texts)]
    if len(numbers) % 2:
        raise ConfigError(f"waypoint {len(numbers) // 2 + 1}: has an X and no Y; write X Y [X Y ...] in meters")
    return _counted(tuple(zip(numbers[::2], numbers[1::2], strict=True)), "", "e.g. sightline goto r1 1.5 1.5")


def waypoints_of_file(text: str, name: str) -> Waypoints:
    """Parse waypoints from the `text` of a file. Raises ConfigError that names file and line."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        parts = line.partition("#")[0].replace(",", " ").split()
        if not parts:
            continue
        if len(parts) != 2:
            raise ConfigError(f"{name}:{number}: has {len(parts)} numbers; write X Y in meters, one waypoint per line")
        found.append((_number(parts[0], f"{name}:{number}"), _number(parts[1], f"{name}:{number}")))
    return _counted(tuple(found), f"{name}: ", "one X Y per line")


def _number(text: str, where: str) -> float:
    if not _NUMBER.fullmatch(text):
        fix = "write X Y in meters, e.g. 1.5 -0.5"
        if text.startswith("-"):
            fix = "`sightline goto --help` lists the options"
        if _NUMBER.fullmatch(text.replace(",", ".")):
            fix = f"write {text.replace(',', '.')}"
        raise ConfigError(f"{where}: invalid number '{text}'; {fix}")
    value = float(text)
    if not abs(value) <= MAX_WAYPOINT_M:
        raise ConfigError(f"{where}: {text} m is out of range; expected {-MAX_WAYPOINT_M:g} to {MAX_WAYPOINT_M:g} m")
    return value


def _counted(found: Waypoints, where: str, form: str) -> Waypoints:
    if not 1 <= len(found) <= MAX_WAYPOINTS:
        raise ConfigError(f"{where}{len(found)} waypoints; expected 1 to {MAX_WAYPOINTS}, {form}")
    return found


# Request a mission and follow its reports, over any `Link`:
#
# with open_link("r1", connect=[...], role="operator") as link:
#     MissionClient(link).request("goto", waypoints=((1.5, 1.5),))


REPEAT_S: Final = 0.2
PATIENCE_S: Final = 3.0
"""The time of six reports, slightly more than the largest accepted age of a mission request."""
_REPORTER: Final = "vision"


class MissionClient:
    """Sends an operator's mission requests to one vision service. Every wait has a limit."""

    def __init__(self, link: Link) -> None:
        """Subscribe to the mission reports.

        Args:
            link: open link to the robot, with the role `operator`.
        """
        self._link = link
        self.operator = Operator(link)
        self._session = secrets.token_hex(4)
        self._id = self._seq = 0
        self._changed = threading.Condition()
        self._report: MissionReport | None = None
        self._received, self._received_s = 0, 0.0
        link.subscribe(REPORT, self._on_report)

    def newest(self, timeout_s: float) -> MissionReport | None:
        """Return the newest report, for display, if one arrived recently or arrives within `timeout_s`."""
        with self._changed:
            self._changed.wait_for(self._is_fresh, timeout_s)
            return self._report if self._is_fresh() else None

    def _is_fresh(self) -> bool:
        return self._report is not None and time.monotonic() - self._received_s < PATIENCE_S

    def report(self, timeout_s: float = PATIENCE_S) -> MissionReport:
        """Wait for the next report.

        Args:
            timeout_s: longest wait, s.

        Raises:
            LinkError: no report in time.
        """
        return self._next(lambda _report: True, timeout_s)

    def request(self, name: str, waypoints: Waypoints = (), options: Mapping[str, Any] | None = None) -> MissionReport:
        """Repeat a mission request until a report names it.

        Args:
            name: name of the mission.
            waypoints: (x, y) in the odometry frame, m, for `goto`.
            options: options of the mission.

        Returns:
            The report. If its `refused` is not empty, it is the reason of a rejection.

        Raises:
            ConfigError: the request does not fit the protocol.
            LinkError: no answer from the robot or its vision service.
        """
        self._id += 1
        request = request_of(self._id, name, waypoints, options or {})
        # Repeated requests cite the same status, so the age of a request counts from the first one.
        echo = Echo.of(self.operator.wait_report().stamp)
        mine = self._newest_id()
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
        """Yield each report that differs from the last one, until the requested mission is over.

        Raises:
            LinkError: no report within `timeout_s`, or another mission replaced the requested one.
        """
        mine, previous = self._newest_id(), None
        while True:
            report = self.report(timeout_s)
            if report.asked != mine:
                raise LinkError(f"another request replaced the mission: {report.mission}; repeat the command")
            if report.refused:
                raise LinkError(f"the vision service continues with {report.mission}: {report.refused}")
            if report != previous:
                previous = report
                yield report
            if report.done:
                return

    def _newest_id(self) -> RequestId:
        return RequestId(digest=session_digest(SOURCE, self._session), id=self._id)

    def _next(self, wanted: Callable[[MissionReport], bool], timeout_s: float) -> MissionReport:
        with self._changed:
            received = self._received
            if not self._changed.wait_for(lambda: self._received > received and self._is(wanted), timeout_s):
                raise LinkError(self._silence())
            assert self._report is not None
            return self._report

    def _is(self, wanted: Callable[[MissionReport], bool]) -> bool:
        return self._report is not None and wanted(self._report)

    def _silence(self) -> str:
        robot = self._link.robot
        if self._report is None and self.operator.report is None:
            return f"no status from robot '{robot}' after {PATIENCE_S:g} s; run `sightline robots`"
        if self._report is None:
            return f"no report from a vision service of robot '{robot}' after {PATIENCE_S:g} s; run `sightline vision`"
        now = f"{self._report.mission}: {self._report.phase}"
        return (f"no answer from the vision service of robot '{robot}' after {PATIENCE_S:g} s (last report: {now}); "
                "repeat the command")

    def _on_report(self, message: Message) -> None:
        """Store the report and return; called on a thread of the transport."""
        try:
            report = decode(MissionReport, message.payload, REPORT.max_payload_bytes)
        except WireError:
            return
        if message.source != _REPORTER:
            return
        with self._changed:
            self._report = report
            self._received += 1
            self._received_s = time.monotonic()
            self._changed.notify_all()


def request_of(number: int, name: str, waypoints: Waypoints, options: Mapping[str, Any]) -> MissionRequest:
    """Create the message. Raises ConfigError for a name, a waypoint or an option that the protocol does not permit."""
    try:
        request = MissionRequest(id=number, name=name, waypoints=waypoints, options=dict(options))
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        if first["loc"][0] == "name":
            raise ConfigError(f"invalid mission '{name}': expected lower-case letters, digits and '-'; give your own "
                              "class (package.module:Name) to `sightline vision --mission`") from None
        if first["loc"][0] == "waypoints":
            raise ConfigError(f"invalid waypoints: expected at most {MAX_WAYPOINTS} pairs (x, y), each number "
                              f"{-MAX_WAYPOINT_M:g} to {MAX_WAYPOINT_M:g} m") from None
        where = ".".join(str(part) for part in first["loc"][1:2])
        raise ConfigError(f"invalid option '{where}': expected true, false, a number or a short text, at most "
                          f"{MAX_OPTIONS} options") from None
    if len(encode(request)) > MISSION.max_payload_bytes:
        raise ConfigError(f"the request exceeds {MISSION.max_payload_bytes} bytes; give fewer waypoints")
    return request


# --- reports as text ---------------------------------------------------------------------------------------------


def mission_line(report: MissionReport) -> str:
    """Format mission, phase and note as one line."""
    return printable("".join([f"{report.mission}: {report.phase}", f"; {report.note}" if report.note else "",
                              " (over)" if report.done else ""]))


def mission_lines(report: MissionReport) -> Iterator[str]:
    """Format a report in the columns of `sightline status`."""
    yield f"mission   {mission_line(report)}"
    if report.refused:
        yield f"          last mission request rejected: {report.refused}"
    if report.detector:
        yield f"detector  {detector_line(report)}"
    yield from vision_fault_lines(report)


def vision_fault_lines(report: MissionReport) -> Iterator[str]:
    """Format the exceptions of the vision service so far; empty without exceptions."""
    if report.faults:
        yield f"faults    {counts_text(report.faults)}; the log of the vision service has the tracebacks"


def detector_line(report: MissionReport) -> str:
    """Format the detector, its device, model and time per image."""
    parts = [report.detector, f"on {report.device}" if report.device else "", f"model {report.model}" if report.model
             else "", f"{report.inference_us / 1000:.1f} ms per image" if report.inference_us is not None else ""]
    return printable(", ".join(part for part in parts if part))


def cannot(report: MissionReport) -> bool:
    """Return True if a mission has ended because it failed or cannot reach its goal."""
    return report.done and (report.phase in ("failed", "cannot reach") or report.note.startswith("cannot"))
