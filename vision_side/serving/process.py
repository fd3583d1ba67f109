"""Runs the vision service as a process: opens the link, serves one robot or a fleet, ends on a signal. Shell."""

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Final

from sightline.protocol.errors import ConfigError
from sightline.protocol.log import slow_logged
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT
from sightline.protocol.transports.link import Link
from sightline.protocol.transports.security import date_problem
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.plugin_calls import close_detector
from sightline.vision_side.detect.port import Detector
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.missions.registry import configured_mission
from sightline.vision_side.pipeline import SOURCE
from sightline.vision_side.serving.legacy_robot import LegacyRobotLink, is_legacy
from sightline.vision_side.serving.service import (
    LIVE_S,
    LogLine,
    Observe,
    ServingState,
    endpoints_text,
    open_service,
)

_log: Final = logging.getLogger(__name__)

_WAIT_S = 0.2  # longest delay before a stop signal is noticed


ENDS_WITHIN_S: Final = 3.0
"""Longest end after a signal. After 4 s systemd and containers kill the process without a log line."""
_THREADS_END_S: Final = 0.5
"""Least time for the other threads after the main thread. Only then the thread of `viewing` ends."""


@contextmanager
def ends_on_signal(ending: threading.Event) -> Iterator[None]:
    """Let SIGTERM and SIGINT set `ending` in this context. After ENDS_WITHIN_S the process is ended."""

    def end(_number: int, _frame: FrameType | None) -> None:
        ending.set()

    # Python runs a handler only between two steps of this thread, which may hang in native code. The number of the
    # signal is written to the socket in any case.
    signals, written = socket.socketpair()
    written.setblocking(False)
    left = threading.Event()
    threading.Thread(target=_end_hanging, args=(signals, left), name="end", daemon=True).start()
    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGINT)}
    before_fd = signal.set_wakeup_fd(written.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before_fd)
        for number, handler in before.items():
            signal.signal(number, handler)
        left.set()
        written.close()


def _end_hanging(signals: socket.socket, left: threading.Event) -> None:
    """Wait for a signal. End this process if it does not leave `ends_on_signal`, or does not end, in time."""
    with signals:  # open until the end, because a second signal is written to it, too
        number = signals.recv(1)
        if not number:
            return
        until_s, what = time.monotonic() + ENDS_WITHIN_S, "a detector, a mission or the link does not return"
        if left.wait(ENDS_WITHIN_S):
            threading.main_thread().join()
            what = "a thread of a detector or mission does not end"
            if not _has_hanging_thread(max(until_s, time.monotonic() + _THREADS_END_S)):
                return
        _log.error("%s; ended by force", what)
        logging.shutdown()
        os._exit(128 + number[0])


def _has_hanging_thread(until_s: float) -> bool:
    """Wait for the threads that Python waits for after the main thread. Returns True if one is left at `until_s`."""
    others = [one for one in threading.enumerate() if not one.daemon and one is not threading.main_thread()]
    for one in others:
        one.join(max(0.0, until_s - time.monotonic()))
    return any(one.is_alive() for one in others)


_LOOK_S = 1.0  # time between two looks at the turns of the loop
_PYTHON = str(Path(os.__file__).parent)


def watch_turns(state: ServingState, report: LogLine) -> threading.Thread:
    """Start to log each turn of this thread that lasts LIVE_S, with the line of code that hangs, and its end."""
    watching = threading.Thread(
        target=_report_hangs, args=(state, threading.get_ident(), report), name="turns", daemon=True)
    watching.start()
    return watching


def _report_hangs(state: ServingState, thread: int, report: LogLine) -> None:
    # It counts looks, not seconds, because a process that was suspended does not hang.
    looks, most, turned_s = 0, round(LIVE_S / _LOOK_S), state.turned_s
    while not state.ending.wait(_LOOK_S):
        if state.turned_s == turned_s:
            looks += 1
            if looks == most:
                report(f"vision: no turn ended for {looks * _LOOK_S:g} s: it hangs in {_place(thread)}")
            continue
        if looks >= most:
            report(f"vision: the turn ended after {looks * _LOOK_S:g} s")
        looks, turned_s = 0, state.turned_s


def _place(thread: int) -> str:
    """Return the innermost function of a thread that is not part of Python, with its file and line."""
    frame = sys._current_frames()[thread]
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PYTHON):
        if "-packages" in frame.f_code.co_filename:
            break
        frame = frame.f_back
    return f"{frame.f_code.co_qualname}() of {frame.f_code.co_filename}:{frame.f_lineno}"


def run(config: VisionConfig, observe: Observe | None = None) -> int:
    """Serve until SIGTERM or SIGINT. Returns the exit code 0. `observe` receives the state.

    Raises ConfigError for an invalid endpoint or mission, LinkError if the link cannot be opened.
    """
    from sightline.protocol.transports.flood_limits import limit_floods

    configured_mission(config)  # an unknown mission must fail before any endpoint is opened
    ending = threading.Event()
    with slow_logged(f"vision: waiting for the detector {config.detector.kind} to load"):
        detector = configured_detector(config)

    def observed(state: ServingState) -> None:
        watch_turns(state, _log.warning)
        if observe is not None:
            observe(state)

    if problem := date_problem(config.secure, SOURCE):
        _log.warning("vision: %s", problem)
    run_it = _run_fleet if set("*?") & set(config.robot) or config.share.enabled else _run_one
    with ExitStack() as guard:  # also around the end of the link and of the detector
        try:
            with limit_floods(config.listen, lambda line: _log.info("vision: %s", line)):
                return run_it(config, ending, observed, detector, guard)
        finally:
            close_detector(detector)


def _run_one(
    config: VisionConfig, ending: threading.Event, observe: Observe, detector: Detector, guard: ExitStack
) -> int:
    from sightline.protocol.transports.open import open_link

    legacy = any(is_legacy(one) for one in config.connect)
    listen = config.listen
    if not listen and all(is_legacy(one) for one in config.connect):
        # A legacy robot has no STOP. Its operators send STOP to this service, at the default address.
        listen = (DEFAULT_ENDPOINT,)
    opened = open_link(config.robot, listen=listen, connect=config.connect, role=SOURCE,
                        max_frame_bytes=config.max_frame_bytes, secure=config.secure)
    # Signals are caught only from here on. Until the link is open, they end the process directly.
    with LegacyRobotLink(opened) if legacy else opened as link:
        guard.enter_context(ends_on_signal(ending))
        if legacy:
            _log.info("vision: STOP and disarm of robot %s: sightline stop %s --connect %s", config.robot, config.robot,
                      ", ".join(listen or config.connect))
        _log.info("vision: looking for robot %s at %s", config.robot, endpoints_text(config))
        serve(config, link, ending, _log.info, observe, detector=detector)
    return 0


def _run_fleet(
    config: VisionConfig, ending: threading.Event, observe: Observe, detector: Detector, guard: ExitStack
) -> int:
    from sightline.protocol.transports.zenoh.link import open_fleet
    from sightline.vision_side.serving.fleet import Fleet, SharedFleet

    shared = config.share.enabled
    if web := next((one for one in (*config.listen, *config.connect) if shared and "://" in one), ""):
        raise ConfigError(f"{web}: --share needs Zenoh; write tcp/<host>:<port>")
    opened = open_fleet(config.robot, listen=config.listen, connect=config.connect, role=SOURCE,
                       max_frame_bytes=config.max_frame_bytes, secure=config.secure, by_status=not shared)
    with opened as fleet_link:
        guard.enter_context(ends_on_signal(ending))
        _log.info("vision: looking for robots %s at %s", config.robot, endpoints_text(config))
        fleet = (SharedFleet if shared else Fleet)(config, fleet_link, _log.info, detector)
        fleet.serve(ending, observe)
    return 0


def serve(
    config: VisionConfig, link: Link, ending: threading.Event, report: LogLine, observe: Observe | None = None, *,
    detector: Detector | None = None,
) -> None:
    """Answer frames that come over `link` until `ending` is set."""
    service = open_service(config, link, report, detector)
    state = ServingState(lambda: [service.counts()], ending, time.monotonic(),
                         lambda: not config.connect or link.connected)
    if observe is not None:
        observe(state)
    while state.turns():
        service.turn(_WAIT_S)
    report(f"vision: ended after {service.answered} frames; skipped: {dict(service.skipped) or 'none'}")
