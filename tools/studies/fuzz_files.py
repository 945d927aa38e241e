"""`weldcal benchmark fuzz-files`: damaged files for every reader, read in a child process.

As a program of its own this module is the child: it reads "reader seed case" lines and answers each with a line of JSON.
"""

import json
import os
import resource
import selectors
import shutil
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from weldcal.models.errors import InputError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.report.render import write_atomic
from weldcal.tools.worlds.damaged_files import (
    CRASH,
    GOOD,
    HANG,
    MEMORY,
    READERS,
    Reader,
    Verdict,
    damaged,
    judge,
    lay_out,
)

WATCHDOG_S = 10.0
WORKER = ("-m", "weldcal.tools.studies.fuzz_files")
_START_S = 120.0  # to import everything, on a slow computer
_KEPT = 20  # offending files of each reader and verdict
FREE = 1024**3  # bytes above those of the idle process that any file may take
TIMES = 10  # and as many times the size of the file


@command("benchmark fuzz-files", short_help="Give every file reader damaged files.")
def benchmark_fuzz_files(
    call: Call,
    cases: Annotated[int, option("--cases", "N", "Damaged files for each reader.", min=1)] = 1000,
    readers: Annotated[
        list[str] | None, option("--readers", "NAME", "Only this reader; repeat for more.", show_default="all")
    ] = None,
) -> Outcome:
    """Damage files of every format by its own grammar: each reader must accept or refuse them by a sentence, in 10 s and 1 GB."""
    wanted = chosen(readers or ())
    result = fuzz_files(wanted, cases, call.seed, call.folder("benchmark", "fuzz-files"), call.progress)
    rows = {name: ", ".join(f"{n} {said}" for said, n in count.most_common()) for name, count in result.counts.items()}
    return Outcome(result.summary(), values={}, rows=rows)


@dataclass(frozen=True)
class Finding:
    """A case that was neither accepted nor refused; ``folder`` holds its files."""

    reader: str
    case: int
    said: str
    detail: str
    folder: str


@dataclass(frozen=True)
class FuzzResult:
    """Verdicts by reader, what must not be, the slowest case of each reader (s), and some refusals of each."""

    counts: dict[str, Counter[str]]
    findings: tuple[Finding, ...]
    slowest_s: dict[str, float]
    seed: int

    def summary(self) -> dict[str, Any]:
        """The JSON object."""
        total = sum(self.counts.values(), Counter())
        bad = {f.reader: f for f in reversed(self.findings)}
        first = next(iter(self.findings), None)
        return {
            "state": "failed" if self.findings else "done",
            "reason": None
            if first is None
            else f"{len(self.findings)} damaged files in {len(bad)} readers were neither accepted nor refused; the first, {first.reader} "
            f"case {first.case}: {first.said}.",
            "seed": self.seed,
            "cases": total.total(),
            **{name.replace(" ", "_"): n for name, n in sorted(total.items())},
            "readers": {name: dict(count) for name, count in self.counts.items()},
            "slowest_s": max(self.slowest_s.values(), default=0.0),
            "findings": [vars(f) for f in self.findings],
        }


def chosen(names: Sequence[str]) -> tuple[Reader, ...]:
    """The readers of these names; all where none is named. Raises InputError naming the known ones."""
    known = {reader.name: reader for reader in READERS}
    wrong = next((name for name in names if name not in known), None)
    if wrong is not None:
        raise InputError(f"There is no reader '{wrong}'. Choose some of {', '.join(known)}.")
    return tuple(known[name] for name in names) or READERS


def fuzz_files(
    readers: Sequence[Reader], cases: int, seed: int, out: Path, progress: Progress = no_progress
) -> FuzzResult:
    """Run ``cases`` damaged files through each reader; case k of a reader depends on the seed, the reader and k only.

    Files that were neither accepted nor refused are kept in ``out``; findings.json lists them.
    """
    counts = {reader.name: Counter[str]() for reader in readers}
    slowest = dict.fromkeys(counts, 0.0)
    findings: list[Finding] = []
    with TemporaryDirectory() as place, _Child(Path(place)) as child:
        for n, reader in enumerate(readers):
            for case in range(cases):
                verdict, seconds = child.ask(reader, seed, case)
                slowest[reader.name] = max(slowest[reader.name], seconds)
                counts[reader.name][verdict.said] += 1
                if verdict.said not in GOOD:
                    kept = counts[reader.name][verdict.said] <= _KEPT
                    folder = _keep(reader, seed, case, out) if kept else ""
                    findings.append(Finding(reader.name, case, verdict.said, verdict.detail, folder))
                if case % 50 == 0:
                    progress(reader.name, (n + case / cases) / len(readers))
            # after each reader, since thousands of cases take a while
            result = FuzzResult(counts, tuple(findings), slowest, seed)
            write_atomic(out / "findings.json", json.dumps(result.summary(), indent=1) + "\n")
    return result


def _keep(reader: Reader, seed: int, case: int, out: Path) -> str:
    _, files, _, place = damaged(reader, seed, case)
    folder = out / f"{reader.name}-{case}"
    lay_out(folder, files, reader.target, place)
    return str(folder)


class _Child:
    """A worker process, started anew after it hung, died or took too much memory."""

    def __init__(self, place: Path) -> None:
        self._place = place
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "_Child":
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def ask(self, reader: Reader, seed: int, case: int) -> tuple[Verdict, float]:
        """The verdict of a case, and how many seconds it took with making its files."""
        limit = WATCHDOG_S if self._process is not None else WATCHDOG_S + _START_S
        process = self._process or self._start()
        assert process.stdin is not None
        try:
            process.stdin.write(f"{reader.name} {seed} {case}\n")
            process.stdin.flush()
        except BrokenPipeError:
            self._end()
            return Verdict(CRASH, "the worker ended before the case"), 0.0
        answer = self._line(process, limit)
        if answer is None:
            hung = process.poll() is None
            self._end()
            if hung:
                return Verdict(HANG, f"no answer within {WATCHDOG_S:g} s"), WATCHDOG_S
            return Verdict(CRASH, f"exit {process.returncode}"), 0.0
        said: dict[str, Any] = json.loads(answer)
        if said["said"] == MEMORY:  # the next case begins with little
            self._end()
        return Verdict(said["said"], said["detail"]), said["seconds"]

    def _start(self) -> subprocess.Popen[str]:
        shutil.rmtree(self._place, ignore_errors=True)
        self._place.mkdir()
        command = [sys.executable, "-P", *WORKER, str(self._place)]
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
        )
        return self._process

    def _line(self, process: subprocess.Popen[str], limit: float) -> str | None:
        """The next line of the worker; None where none comes in time, or the worker ends."""
        assert process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(process.stdout, selectors.EVENT_READ)
            if not selector.select(limit):
                return None
        line = process.stdout.readline()
        if not line:
            process.wait()
        return line or None

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


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
