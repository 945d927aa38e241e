"""Measure the processor time of what people wait for, against an earlier commit, in alternating pairs."""

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from weldcal.models.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
SHOTS, BOARD = 50, "chessboard:9x6:20"
KNOWN = ("demo", "calibrate", "part", "seams", "hand-eye")
BRACKETS = 38  # of the assembly whose seams are listed, with 1,000 edges


@contextmanager
def worktree(commit: str) -> Iterator[Path]:
    """Check a commit out into a temporary folder, with the package `weldcal` mapped onto it.

    Raises:
        InputError: there is no such commit.
    """
    with TemporaryDirectory(prefix="weldcal-speed-") as folder:
        root = Path(folder) / "tree"
        added = subprocess.run(
            ["git", "-C", str(ROOT), "worktree", "add", "--detach", str(root), commit], capture_output=True, text=True
        )
        if added.returncode:
            raise InputError(f"There is no commit '{commit}' to measure: {added.stderr.strip().splitlines()[-1]}.")
        try:
            if not (root / ".typing" / "weldcal").exists():
                (root / ".typing").mkdir(exist_ok=True)
                (root / ".typing" / "weldcal").symlink_to(root, target_is_directory=True)
            yield root
        finally:
            subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(root)], check=False)


def write_inputs(folder: Path, names: Sequence[str]) -> dict[str, list[str]]:
    """Write what the commands read, and return the words of each command."""
    from weldcal.tools.commands.cell.new import write_example

    calls = {"demo": ["demo", "--no-browser"]}
    if "calibrate" in names:
        calls["calibrate"] = ["calibrate", str(write_example(folder / "scans"))]
    if {"part", "seams"} & set(names):
        from tests.worlds.parts.step_parts import assembly, box, brackets_on_plate, write_step

        write_step(assembly(box((0, 0, -10), (200, 100, 10)), box((0, 46, 0), (200, 8, 60))), folder / "boxes.step")
        calls["part"] = ["part", str(folder / "boxes.step")]
        write_step(brackets_on_plate(BRACKETS), folder / "brackets.step")
        calls["seams"] = ["part", str(folder / "brackets.step"), "--plan", "0"]
    if "hand-eye" in names:
        from tests.calibration.hand_eye import rendering

        shots, drawing = folder / "shots", rendering.draw_chessboard(9, 6, 20.0)
        found = rendering.world(drawing, 5, SHOTS)
        rendering.write_pictures(shots, drawing, found, 5, sub=2)
        rendering.write_robot(shots / "poses.txt", found.robot, mm=True)
        calls["hand-eye"] = ["hand-eye", "ax-yb", str(shots), "--mounting", "eye_in_hand", "--board", BOARD]
    return {name: calls[name] for name in names}


def processor_s(root: Path, words: Sequence[str], folder: Path) -> float:
    """Run a command of a checkout and return its processor time with that of its processes, s.

    Raises:
        InputError: the command fails.
    """
    out, before = folder / "out", resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "weldcal.tools", *words, "--out", str(out)],
        env=os.environ | {"PYTHONPATH": str(root / ".typing")},
        cwd=folder,
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    shutil.rmtree(out, ignore_errors=True)
    if done.returncode:
        raise InputError(f"'weldcal {' '.join(words)}' failed in {root}: {done.stderr.strip().splitlines()[-1:]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compared(roots: Sequence[Path], words: Sequence[str], pairs: int, folder: Path) -> list[list[float]]:
    """Measure a command in checkouts by turns; the first run of each compiles, and does not count."""
    times: list[list[float]] = [[] for _ in roots]
    for root in roots:
        processor_s(root, words, folder)
    for number in range(pairs):
        order = range(len(roots)) if number % 2 == 0 else reversed(range(len(roots)))
        for k in order:
            times[k].append(processor_s(roots[k], words, folder))
    return times


def row(name: str, times: Mapping[str, Sequence[float]]) -> str:
    """Print the medians of a command and, of two checkouts, the median of the ratios of their pairs."""
    cells = [name, *(f"{median(some):.2f}" for some in times.values())]
    if len(times) == 2:
        old, new = times.values()
        ratios = [b / a for a, b in zip(old, new, strict=True)]
        cells += [f"{median(ratios):.2f}", f"{min(ratios):.2f} to {max(ratios):.2f}"]
    return f"| {' | '.join(cells)} |"


def speed(
    against: Annotated[str, typer.Option("--against", help="Commit to compare with; else nothing is compared.")] = "",
    pairs: Annotated[int, typer.Option("--pairs", min=1, help="Runs of each, by turns.")] = 3,
    only: Annotated[str, typer.Option("--only", help=f"Some of {', '.join(KNOWN)}, with commas.")] = ",".join(KNOWN),
) -> None:
    """Measure the processor time of what people wait for, beside an earlier commit."""
    names = [name for name in KNOWN if name in only.split(",")]
    if not names or set(only.split(",")) - set(KNOWN):
        raise typer.BadParameter(f"give some of {', '.join(KNOWN)}, not '{only}'.", param_hint="'--only'")
    try:
        with TemporaryDirectory(prefix="weldcal-speed-") as folder:
            calls = write_inputs(Path(folder), names)
            head = ["processor time, s", *([against] if against else []), "now"]
            head += ["ratio", "of the pairs"] if against else []
            typer.echo(f"| {' | '.join(head)} |\n|{'---|' * len(head)}")
            if not against:
                for name, words in calls.items():
                    typer.echo(row(name, {"now": compared([ROOT], words, pairs, Path(folder))[0]}))
                return
            with worktree(against) as old:
                for name, words in calls.items():
                    before, now = compared([old, ROOT], words, pairs, Path(folder))
                    typer.echo(row(name, {against: before, "now": now}))
    except InputError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(1) from error
