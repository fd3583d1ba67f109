"""A person at the robot, as a process: asks for STOP (then reset), or for what the robot says of itself. Shell."""

import threading
from typing import TYPE_CHECKING

from sightline.operator_side.faults.ledger import INJECTED, REQUESTED, EventLog
from sightline.operator_side.client.requests import SOURCE as OPERATOR_SOURCE
from sightline.operator_side.client.requests import Operator
from sightline.protocol.messages import Verb
from sightline.protocol.transports.zenoh.link import open_zenoh

if TYPE_CHECKING:
    from sightline.evaluation.faults.peer import PeerOptions


def run_operator(options: "PeerOptions", pulled: threading.Event, ledger: EventLog) -> int:
    """Wait for the trigger, ask, and say what was answered."""
    with open_zenoh(options.robot, connect=[options.endpoint], role=OPERATOR_SOURCE, timeout_s=15) as link:
        operator = Operator(link)
        operator.wait_report(10.0)
        print("person ready", flush=True)
        pulled.wait()
        if options.fault == "lateness":
            print(f"late by {operator.wait_report(10.0).status.tick_late_max_us} us", flush=True)
            return 0
        ledger.note(REQUESTED)
        ledger.note(INJECTED)
        print(f"state {operator.stop(lambda: None).state}", flush=True)
        if options.fault == "reset":
            reply = operator.ask(Verb.RESET)
            print(f"reset {reply.ok}: {reply.detail}", flush=True)
    return 0
