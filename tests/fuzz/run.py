"""Give every file reader damaged files, read in a child process: `python -m tests.fuzz.run --cases 1000`.

Files of every format are damaged by its own grammar: each reader must accept or refuse them by a sentence, in 10 s and
1 GB.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tests.fuzz.damaged_files import GOOD, READERS, Child, Reader, damaged, lay_out
from weldcal.models.errors import InputError
from weldcal.systems.runner import Progress, no_progress
from weldcal.tools.report.render import write_atomic

_KEPT = 20  # offending files of each reader and verdict


@dataclass(frozen=True)
class FuzzFailure:
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
    findings: tuple[FuzzFailure, ...]
    slowest_s: dict[str, float]
    seed: int

    def summary(self) -> dict[str, Any]:
        """Return the JSON object."""
        total = sum(self.counts.values(), Counter())
        bad = {f.reader: f for f in reversed(self.findings)}
        first = next(iter(self.findings), None)
        return {
            "state": "failed" if self.findings else "done",
            "reason": (
                None
                if first is None
                else (
                    f"{len(self.findings)} damaged files in {len(bad)} readers were neither accepted nor refused; the"
                    f" first, {first.reader} case {first.case}: {first.said}."
                )
            ),
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
    findings: list[FuzzFailure] = []
    with TemporaryDirectory() as place, Child(Path(place)) as child:
        for n, reader in enumerate(readers):
            for case in range(cases):
                verdict, seconds = child.ask(reader, seed, case)
                slowest[reader.name] = max(slowest[reader.name], seconds)
                counts[reader.name][verdict.said] += 1
                if verdict.said not in GOOD:
                    kept = counts[reader.name][verdict.said] <= _KEPT
                    folder = _keep(reader, seed, case, out) if kept else ""
                    findings.append(FuzzFailure(reader.name, case, verdict.said, verdict.detail, folder))
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


def main() -> bool:
    """Run the cases of the command line, print the verdicts of each reader, and return whether one must not be."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--cases", type=int, default=1000, help="damaged files for each reader")
    words.add_argument("--readers", action="append", default=[], metavar="NAME", help="only this; repeat for more")
    words.add_argument("--seed", type=int, default=0)
    words.add_argument("--out", type=Path, default=Path("build/fuzz"), help="folder of the findings")
    asked = words.parse_args()
    result = fuzz_files(chosen(asked.readers), asked.cases, asked.seed, asked.out)
    for name, count in result.counts.items():
        print(f"{name}: {', '.join(f'{n} {said}' for said, n in count.most_common())}")
    return bool(result.findings)


if __name__ == "__main__":
    sys.exit(main())
