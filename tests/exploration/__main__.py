"""`python -m tests.exploration` explores all parts, and prints the number of states or the first violation."""

import argparse
import os
import signal
import sys
import time

from tests.exploration.search import PARTS, explore


def main() -> int:
    """Return the exit code: 0, or 5 if a promise breaks."""
    parser = argparse.ArgumentParser(prog="python -m tests.exploration", description=__doc__)
    parser.add_argument("--only", choices=PARTS, action="append", help="a part; repeatable")
    parser.add_argument("--states", type=int, default=10_000_000, help="end a part after so many states")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # and with it the workers
    known, began_s = set(), time.monotonic()
    for name in options.only or PARTS:
        found = explore(name, min(options.states, PARTS[name].most), options.jobs)
        known |= found.states  # two parts may find the same one
        if found.promise:
            print(f"{name}: broken: {found.promise}", *found.words, sep="\n")
            return 5
        end = "no event leads to another one" if found.all_of_them else f"all orders of {found.depth} events, and more"
        print(f"{name}: {len(found.states)} states; {end}", flush=True)
    used = os.times()
    cpu_s = used.user + used.system + used.children_user + used.children_system
    took_s = time.monotonic() - began_s
    print(f"{len(known)} different states break no promise, in {took_s:.0f} s ({cpu_s:.0f} s of CPU time)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
