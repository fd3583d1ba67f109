"""`sightline metrics`: a robot's status for Prometheus. Shell."""

import signal
import threading
from importlib import import_module
from typing import Annotated

import typer

from sightline.operator_side.cli.options import DEFAULT_CONNECT, Connect, Robot, Secure
from sightline.operator_side.preflight import needs
from sightline.protocol.transports.open import open_link

ROLE = "metrics"


def register_metrics(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline metrics r1 --connect tcp/192.168.1.20:7447 --port 9464")(metrics)


def metrics(
    robot: Robot = "r1",
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    host: Annotated[str, typer.Option(help="Address to serve on; 0.0.0.0 is a decision.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to serve on.")] = 9464,
) -> int:
    """Serve a robot's status to Prometheus at /metrics, and whether it is heard at /health, until Ctrl-C."""
    with needs("metrics"):
        import_module("prometheus_client")
    from sightline.operator_side.metrics import Watched
    from sightline.operator_side.cockpit.metrics import serving

    ending = threading.Event()
    with open_link(robot, connect=connect, role=ROLE, secure=secure) as link, serving(Watched(link), host, port) as at:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda _number, _frame: ending.set())
        typer.echo(f"metrics of {robot}: http://{host}:{at}/metrics")
        ending.wait()
    return 0
