"""Run golden calls and compare their figures with the kept ones, or keep the new ones.

python -m tests.golden [NAME...] [--keep] [--folder FOLDER]      without names: all; --keep writes what came out
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from tests.golden.calls import CALLS
from tests.golden.run import Runs, held, keep


def main() -> int:
    """Run the calls; the exit code is 1 where a figure differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="calls (tests/golden/calls.py); default: all")
    parser.add_argument("--keep", action="store_true", help="write the figures as the ones to hold")
    parser.add_argument("--folder", type=Path, help="where results are written and found again")
    given = parser.parse_args()
    unknown = sorted(set(given.names) - set(CALLS))
    if unknown:
        parser.error(f"no call is named {', '.join(unknown)}; the calls are {', '.join(CALLS)}")
    with tempfile.TemporaryDirectory() as scratch:
        runs = Runs(given.folder or Path(scratch))
        worse = 0
        for name in given.names or CALLS:
            began = time.monotonic()
            found = runs.differences(name)
            took = time.monotonic() - began
            if given.keep:
                keep(name, runs.figures(name))
                print(f"{name}: kept, {len(held(name))} figures, {took:.0f} s, {len(found)} differed", flush=True)
                continue
            print(f"{name}: {'holds' if not found else 'differs'}, {took:.0f} s", *found[:20], sep="\n  ", flush=True)
            worse += bool(found)
    return min(worse, 1)


if __name__ == "__main__":
    raise SystemExit(main())
