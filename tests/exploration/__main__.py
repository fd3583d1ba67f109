"""`python -m tests.exploration` explores all parts, and prints the number of states or the first violation."""

import argparse
import os
import sys
import time

from tests.exploration.search import PARTS, explore


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.exploration", description=__doc__)
    parser.add_argument("--only", choices=PARTS, action="append", help="a part; repeatable")
    parser.add_argument("--states", type=int, default=10_000_000, help="end a part after so many states")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    options = parser.parse_args()
    for part in options.only or PARTS:
        began_s = time.monotonic()
        found = explore(part, options.states, options.jobs)
        took_s = time.monotonic() - began_s
        print(f"{part}: {found.states} states, {'all' if found.all_of_them else 'not all'} of them, up to {found.depth} "
              f"events deep, in {took_s:.0f} s, {found.states / took_s:.0f} a second")
        if found.promise:
            print(f"broken: {found.promise}", *found.words, sep="\n")
            return 5
    return 0


if __name__ == "__main__":
    sys.exit(main())
