"""The child process of the fuzzer: reads "reader seed case" lines and answers each with a line of JSON."""

import json
import os
import resource
import sys
import time
import warnings
from pathlib import Path

from weldcal.tools.studies.files.cases import MEMORY, Verdict, judge
from weldcal.tools.studies.files.readers import READERS

FREE = 1024**3  # bytes above those of the idle process that any file may take
TIMES = 10  # and as many times the size of the file


def main() -> None:
    """Work in the folder that is the first argument until the input ends."""
    folder = Path(sys.argv[1])
    os.chdir(folder)
    warnings.simplefilter("ignore")
    readers = {reader.name: reader for reader in READERS}
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print must not come between the answers
    idle = _peak()
    for line in sys.stdin:
        name, seed, case = line.split()
        place = folder / "case"
        begin = time.monotonic()
        verdict = judge(readers[name], int(seed), int(case), place)
        seconds = time.monotonic() - begin
        size = sum(p.stat().st_size for p in place.rglob("*") if p.is_file() and not p.is_symlink())
        if too_much(_peak() - idle, size):
            verdict = Verdict(MEMORY, f"{(_peak() - idle) / 2**20:.0f} MiB for {size} bytes; {verdict.said}")
        answers.write(json.dumps({"said": verdict.said, "detail": verdict.detail, "seconds": seconds}) + "\n")
        answers.flush()


def too_much(taken: int, size: int) -> bool:
    """Whether a case took more bytes than files of so many bytes may."""
    return taken > FREE + TIMES * size


def _peak() -> int:
    """The largest resident size so far, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main()
