"""Change the formulas of `tests/mutations.txt` one by one; the closest tests must fail.

A stated list, and no tool that makes mutations up (cosmic-ray, mutmut): those make thousands of a file, with the same
tests for each, days of computing, and most survivors change nothing that matters. Here every line is a formula that a
result depends on.
"""

import itertools
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from weldcal.models.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
LIST = ROOT / "tests" / "mutations.txt"
KILLED, SURVIVED, ERROR = "killed", "survived", "error"
_LONGEST_S = 1800.0
_LEAST_S = 120.0  # beside twice the time of the unmutated tests: compiled loops are compiled anew
_RULES = {"-": "text", "+": "replacement", "=": "why"}
_LEFT_OUT = shutil.ignore_patterns(".*", "build", "weldcal-out")


@dataclass(frozen=True, kw_only=True)
class Mutation:
    """One changed formula.

    Attributes:
        file: below the root. tests: arguments for pytest. reason: what is changed.
        text, replacement: a part of the file, and what is written in its place.
        why: the reason why no test can fail; "" where one must.
    """

    file: str
    tests: tuple[str, ...]
    reason: str
    text: str = ""
    replacement: str = ""
    why: str = ""

    def applied(self, source: str) -> str:
        """Return the file with this mutation.

        Raises:
            InputError: the text does not occur exactly once.
        """
        if (found := source.count(self.text)) != 1:
            raise InputError(
                f"The text of the mutation '{self.reason}' occurs {found} times in {self.file}: correct {LIST.name}."
            )
        return source.replace(self.text, self.replacement)


def read_mutations(text: str) -> tuple[Mutation, ...]:
    """Read a list: "file: tests" at the margin, then indented reason, "- text" and "+ replacement" of each.

    Raises:
        InputError: a line has another form.
    """
    found: list[Mutation] = []
    heading: tuple[str, tuple[str, ...]] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        mark, _, rest = line.strip().partition(" ")
        if not mark or line.startswith("#"):
            continue
        if not line.startswith(" ") and mark.endswith(".py:") and rest:
            heading = mark[:-1], tuple(rest.split())
        elif line.startswith(" ") and mark in _RULES and found:
            found[-1] = Mutation(**vars(found[-1]) | {_RULES[mark]: rest.strip()})
        elif line.startswith(" ") and heading:
            found.append(Mutation(file=heading[0], tests=heading[1], reason=line.strip()))
        else:
            raise InputError(f"Line {number} of {LIST.name} is no file with its tests, reason, '- text' or '+ text'.")
    return tuple(found)


@dataclass(frozen=True)
class _Copy:
    """A copy of the project, in which one mutation at a time is tested."""

    root: Path

    def passes(self, tests: Sequence[str], limit_s: float) -> tuple[bool | None, str]:
        """Return whether tests pass, None where they could not run, and pytest's last line."""
        run = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
        # pytest's own variables are of the run that calls this one. No byte code is written: two mutations of one
        # length within a second have the same stamp, and the second would run the byte code of the first.
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
        fixed = {"PYTHONPATH": str(self.root.parent), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        environment = inherited | fixed
        try:
            done = subprocess.run(
                run, cwd=self.root, env=environment, capture_output=True, text=True, check=False, timeout=limit_s
            )
        except subprocess.TimeoutExpired:
            return False, f"did not end within {limit_s:.0f} s"
        failed = re.findall(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
        last = (done.stdout.splitlines() or done.stderr.splitlines() or ["no output"])[-1]
        said = failed[-1].rpartition("::")[2] if failed else last
        return {0: True, 1: False}.get(done.returncode), said

    def verdict(self, mutation: Mutation, limit_s: float) -> tuple[str, str]:
        """What the closest tests say of a mutation, and the test that failed."""
        file = self.root / mutation.file
        original = file.read_text()
        file.write_text(mutation.applied(original))
        try:
            passed, said = self.passes(mutation.tests, limit_s)
        finally:
            file.write_text(original)
        return (ERROR if passed is None else SURVIVED if passed else KILLED), said


def run_mutations(
    mutations: Sequence[Mutation], jobs: int, progress: Callable[[str, float], None]
) -> Iterator[tuple[Mutation, str, str]]:
    """Each mutation with its verdict and the test that failed, as they are ready.

    Raises:
        InputError: a text does not occur exactly once, or tests fail without a mutation.
    """
    for mutation in mutations:
        mutation.applied((ROOT / mutation.file).read_text())
    with TemporaryDirectory(prefix="weldcal-mutate-") as folder:
        here, numbers = threading.local(), itertools.count()

        def copy_project() -> None:
            place = Path(folder) / str(next(numbers))
            shutil.copytree(ROOT, place / ROOT.name, ignore=_LEFT_OUT)
            (place / "shared").symlink_to(ROOT.parent / "shared")
            here.copy = _Copy(place / ROOT.name)

        def unmutated(tests: tuple[str, ...]) -> float:
            begin = time.monotonic()
            passed, said = here.copy.passes(tests, _LONGEST_S)
            if not passed:
                raise InputError(f"Without a mutation {' '.join(tests)} does not pass: {said}. Repair that first.")
            return time.monotonic() - begin

        groups = tuple(dict.fromkeys(mutation.tests for mutation in mutations))
        with ThreadPoolExecutor(jobs, initializer=copy_project) as pool:
            try:
                took: dict[tuple[str, ...], float] = {}
                for tests, seconds in zip(groups, pool.map(unmutated, groups), strict=True):
                    took[tests] = seconds
                    progress(f"without a mutation: {tests[0]}", len(took) / (len(groups) + len(mutations)))
                waiting = {
                    pool.submit(lambda m: here.copy.verdict(m, _LEAST_S + 2.0 * took[m.tests]), m): m for m in mutations
                }
                for count, done in enumerate(as_completed(waiting), len(groups) + 1):
                    progress(waiting[done].reason, count / (len(groups) + len(mutations)))
                    yield waiting[done], *done.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)  # an interrupt does not wait for the rest


def mutate(
    only: Annotated[str, typer.Option("--only", help="Mutations whose file or reason holds this.")] = "",
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Copies of the project tested side by side.")] = 1,
) -> None:
    """Apply each mutation of tests/mutations.txt to a copy of the project and run its closest tests: they must fail."""
    chosen = [m for m in read_mutations(LIST.read_text()) if only in f"{m.file} {m.reason}"]
    count: Counter[str] = Counter()
    bad = []
    for m, verdict, said in run_mutations(chosen, jobs, lambda stage, share: None):
        print(f"{verdict:9} {m.file}: {m.reason} ({m.why or said})", flush=True)
        count[verdict] += 1
        bad += [m.reason] if verdict == ERROR or (verdict == SURVIVED and not m.why) else []
    print(f"{count[KILLED]} of {len(chosen)} killed, {count[SURVIVED]} survived, {count[ERROR]} errors")
    if bad or not chosen:
        why = f"{len(bad)} mutations survive without a reason, the first: {bad[0]}." if bad else f"'{only}' has none."
        typer.echo(why, err=True)
        raise typer.Exit(1)
