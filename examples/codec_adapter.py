"""Run a codec on a pipe for `sightline conform codec -- python examples/codec_adapter.py`. Shell.

Each line of stdin is a question, and each line of stdout an answer, both JSON. This program uses Sightline's own codec.
Write the same program in your language, with your codec in place of `outcome` and `format_twist`.
"""

import base64
import json
import sys
from typing import Any

from sightline.protocol.messages import Twist
from sightline.protocol.spec.framing_cases import READERS, framing_outcome
from sightline.protocol.spec.golden import outcome
from sightline.protocol.text import format_twist


def answer(question: dict[str, Any]) -> dict[str, Any]:
    """Return the answer without its id."""
    if question["kind"] == "message":
        header, payload = (base64.b64decode(question[name]) for name in ("header", "payload"))
        came_to = outcome(question["key"], header, payload)
        return {"ok": came_to["accept"]} if "accept" in came_to else {"refusal": came_to["refuse"]}
    if question["kind"] == "write_twist":
        twist = Twist(linear_mps=question["linear_mps"], angular_rad_s=question["angular_rad_s"])
        return {"ok": format_twist(twist).decode("ascii")}
    if question["kind"] in READERS:
        came_to = framing_outcome(question["kind"], question)
        return {"ok": came_to["accept"]} if "accept" in came_to else {"refusal": came_to["refuse"]}
    return {"unsupported": True}


def main() -> None:
    """Answer until stdin ends."""
    for line in sys.stdin:
        question = json.loads(line)
        print(json.dumps({"id": question["id"], **answer(question)}), flush=True)


if __name__ == "__main__":
    main()
