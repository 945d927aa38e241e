"""The folder of a result: one command at a time writes there, and an earlier result is not overwritten."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from weldcal.models.errors import InputError
from weldcal.models.files import UNFINISHED

RUNNING = ".weldcal-running"
"""The file that a folder holds while a command writes there, with the number of its process."""
JOURNAL = "tasks.jsonl"
MEASURED_TOOL = "tool_measurement.json"
RECORDING: Final = "recording.mcap"
SCANS: Final = "scans"
SUMMARY: Final = "summary.json"
RESULTS = (
    "report.html", "calibration.yaml", "monitor.json", "verification.json", "run.json", "runs.csv", "summary.txt",
    "board.pdf", "tool.html", "finger.yaml", "edges.csv", "findings.json", "best.script", "poses.script", "touches.csv",
    "camera.yaml", "progress.json",
)  # fmt: skip
"""Files by which a folder is known to hold a result."""
_PATIENCE_S = 1.0  # for the number of a process that has just created its file


@contextlib.contextmanager
def claimed(folder: Path, *, overwrite: bool = False, resumes: bool = False) -> Iterator[None]:
    """Keep a result folder for this process within the block.

    A folder of a run that was killed (it holds UNFINISHED) may be written again. Nothing is left of a block that writes
    nothing.

    Args:
        folder: where the result is written.
        overwrite: write over the files of an earlier result.
        resumes: the command goes on where the journal of its tasks in the folder ends.

    Raises:
        InputError: the folder holds a result, or another process writes there.
    """
    if not (overwrite or (folder / UNFINISHED).exists() or (resumes and _has_journal(folder))):
        _require_no_result(folder)
    created = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    mark = folder / RUNNING
    ours = _take(mark, folder)
    try:
        yield
    finally:
        if ours:
            mark.unlink(missing_ok=True)
        for one in created:
            with contextlib.suppress(OSError):
                one.rmdir()  # only where it is empty


def _require_no_result(folder: Path) -> None:
    found = next((name for name in RESULTS if (folder / name).exists()), None)
    if found is not None:
        raise InputError(
            f"'{folder}' already holds a result ({found}). Give another folder with --out, or add --overwrite to write"
            " over it."
        )


def _has_journal(folder: Path) -> bool:
    """Return whether the folder holds the journal of a study, or of one of its steps."""
    return any(True for pattern in (JOURNAL, f"*/{JOURNAL}") for _ in folder.glob(pattern))


def _take(mark: Path, folder: Path) -> bool:
    """Write the mark; False where this process wrote it already."""
    while True:
        try:
            handle = os.open(mark, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            process = _process(mark)
            if process == os.getpid():
                return False
            if process is not None and _runs(process):
                raise InputError(
                    f"Another weldcal (process {process}) writes into '{folder}'. Wait until it has ended, or give"
                    " another folder with --out."
                ) from None
            mark.unlink(missing_ok=True)  # of a process that was killed
            continue
        with os.fdopen(handle, "w") as file:
            file.write(f"{os.getpid()}\n")
        return True


def writer(folder: Path) -> int | None:
    """Number of the process that writes into a folder now; None where none does."""
    process = _process(folder / RUNNING) if (folder / RUNNING).exists() else None
    return process if process is not None and _runs(process) else None


def _process(mark: Path) -> int | None:
    until = time.monotonic() + _PATIENCE_S
    while time.monotonic() < until:
        try:
            return int(mark.read_text())
        except FileNotFoundError:
            return None
        except ValueError:
            time.sleep(0.05)
    return None


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
