"""Runs a Zenoh router to which robots, vision services and operators of one site connect. Shell.

A stock `zenohd` also works, without the access rules of `--secure`.
"""

import logging
import signal
import threading
from collections.abc import Sequence
from contextlib import closing
from typing import Final

from sightline.protocol.transports.endpoints import check_zenoh_endpoints
from sightline.protocol.transports.security import ROBOT_ROLE, load_role_keys
from sightline.protocol.transports.zenoh.session import open_session, report_floods

_log: Final = logging.getLogger(__name__)

_REACH_S = 5.0


def run(listen: Sequence[str], connect: Sequence[str], secure: str) -> int:
    """Serve until SIGTERM or SIGINT. Raises ConfigError and LinkError as `open_session` does."""
    check_zenoh_endpoints(listen, connect)
    secured = load_role_keys(secure, ROBOT_ROLE)
    ending = threading.Event()
    with (
        report_floods(listen, lambda line: _log.info("router: %s", line)),
        closing(open_session(listen, connect, _REACH_S, secured)),
    ):
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda _number, _frame: ending.set())
        rules = f"keys of {secure}, access rules on" if secure else "no keys, every client that reaches it may connect"
        _log.info("router: on %s; %s", ", ".join(listen), rules)
        ending.wait()
    _log.info("router: ended")
    return 0
