"""`sightline teleop`: a person drives with the keyboard or a gamepad. Shell."""

import secrets
from contextlib import ExitStack
from typing import Annotated

import typer

from sightline.operator_side.cli.options import DEFAULT_CONNECT, Connect, Robot, Secure

_Gamepad = Annotated[
    str | None,
    typer.Option(
        "--gamepad", metavar="DEVICE", help="A gamepad too: /dev/input/event5, or `auto` for the first one found."
    ),
]


def register_teleop(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline teleop r1 --connect tcp/192.168.1.20:7447 --linear 0.15")(teleop)


def teleop(
    robot: Robot = "r1",
    *,
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    linear: Annotated[float, typer.Option(min=0.02, max=3, help="Speed to begin with, m/s.")] = 0.2,
    angular: Annotated[float, typer.Option(min=0.1, max=10, help="Turn rate to begin with, rad/s.")] = 1.0,
    gamepad: _Gamepad = None,
) -> None:
    """Drive a robot by hand: hold a key of u i o j l m , . and let go to stop. `a` hands over to vision.

    The first press arms the robot. STOP is another command (`sightline stop`), and no key starts a stopped robot.
    """
    from sightline.operator_side.teleop.control import SOURCE, Teleop
    from sightline.operator_side.teleop_evdev import Gamepad
    from sightline.operator_side.teleop_speed import Speeds
    from sightline.operator_side.teleop_terminal import Cockpit, check_terminal
    from sightline.protocol.transports.open import open_link

    check_terminal()
    session = secrets.token_hex(4)
    with ExitStack() as ending:
        pad = Gamepad(gamepad) if gamepad else None
        if pad is not None:
            ending.callback(pad.close)
        link = ending.enter_context(open_link(robot, connect=connect, role=SOURCE, secure=secure))
        Cockpit(link, Teleop(session, Speeds(linear, angular)), pad).run()
