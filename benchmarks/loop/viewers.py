"""Viewers of the robot's pictures, for `bench watchers`: `python -m sightline.benchmarks.loop.viewers ENDPOINT COUNT NAP_S`. Shell.

Opens COUNT links, each with its own connection, and takes every frame; with NAP_S it sleeps so long over each one, on
the transport's thread, so that its connection is read no faster than that.
"""

import sys
import threading
import time
from contextlib import ExitStack

from sightline.benchmarks.loop.ours import ROBOT
from sightline.protocol.channels import FRAME
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.open import open_link


def main(endpoint: str, count: int, nap_s: float) -> None:
    """Watch until killed."""
    seen = threading.Event()

    def watch(_message: Message) -> None:
        seen.set()
        time.sleep(nap_s)

    with ExitStack() as ending:
        for number in range(count):
            link = ending.enter_context(open_link(ROBOT, connect=[endpoint], role=f"viewer{number}"))
            link.subscribe(FRAME, watch)
        seen.wait()
        print("watching", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
