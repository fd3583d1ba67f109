"""What `sightline teleop` shows: the keys once, and one line that follows the robot. Pure."""

from typing import Final

from sightline.operator_side.client.status import millis, twist_text
from sightline.operator_side.teleop.control import Mode, Teleop
from sightline.protocol.messages import Status

KEYS: Final = """\
      forward            hold a key to drive, let go to stop
   u     i     o
 turn j  k  l turn       k or space   stop
   m     ,     .         q z  both speeds 10 % up, down
       back              w x  linear only    e c  turning only
                         a    hand over to vision; any of u i o j l m , . takes back
Ctrl-C ends it. The first press arms the robot: make sure that it may move.
"""


_SILENT_US: Final = 1_000_000
"""Ten times as long as a robot is silent between two words."""


def live_line(robot: str, teleop: Teleop, width: int, now_us: int) -> str:
    """State, reason, who drives, speeds; cut to the terminal's width, so that it stays one line. Of a robot that has
    fallen silent nothing is known any more."""
    if teleop.report is None:
        text = f"{robot}: {teleop.note or 'nothing heard yet'}"
    elif (silent_us := now_us - teleop.heard_us) > _SILENT_US:
        text = f"{robot}: nothing heard for {silent_us / 1e6:.0f} s; without commands it stops by itself"
    else:
        text = " | ".join(part for part in _parts(robot, teleop, teleop.report.status) if part)
    return text if len(text) <= width else text[: max(0, width - 1)] + "…"


def _parts(robot: str, teleop: Teleop, status: Status) -> list[str]:
    """What matters most comes first: narrow terminals cut the rest."""
    speeds = teleop.speeds
    return [
        f"{robot} {status.state}: {status.reason}",
        "" if teleop.sees else "no picture yet, and a command must cite one: is its camera running?",
        teleop.note,
        _driver(teleop, status),
        twist_text(status.applied),
        f"up to {speeds.linear_mps:.2f} m/s {speeds.angular_rad_s:.2f} rad/s",
        f"frame {millis(status.frame_age_us)}",
    ]


def _driver(teleop: Teleop, status: Status) -> str:
    holder = status.holder
    if holder is None:
        return "nobody drives" if teleop.mode is not Mode.HANDING_OVER else Mode.HANDING_OVER.value
    if holder.session == teleop.session:
        return "you drive"
    return f"{holder.source} drives"
