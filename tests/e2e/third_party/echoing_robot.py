"""A robot's end of a WebSocket link that returns in `status` each twist of a teleop: `echoing_robot.py V1 OLDER`.

For each line of its input, it prints its counts of rejections, how many callbacks raised, and its memory in KiB.
"""

import json
import sys
from pathlib import Path

from sightline.protocol.channels import ACK, DETECTIONS, REQUEST, STATUS, TWIST
from sightline.protocol.log import faults
from sightline.protocol.transports.websocket.link import open_websocket

with open_websocket("r1", listen=sys.argv[1:3], role="robot") as link:
    link.subscribe(TWIST, lambda message: message.source == "teleop" and link.publish(STATUS, b"{}", message.payload))
    for channel in (ACK, REQUEST, DETECTIONS):
        link.subscribe(channel, lambda message: None)
    print("up", flush=True)
    for _ in sys.stdin:
        kib = int(Path("/proc/self/statm").read_text().split()[1]) * 4
        print(json.dumps({"refused": link.rejected, "raised": faults()["callback"], "kib": kib}), flush=True)
