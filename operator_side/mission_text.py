"""What vision reports of itself, in words. Pure."""

from collections.abc import Iterator

from sightline.protocol.mission_messages import MissionReport


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
