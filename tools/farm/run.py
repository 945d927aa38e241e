"""Runs tasks on any number of workers, the same numbers to the last bit, and goes on after an interruption."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from weldcal.calibration.data.results import software_version
from weldcal.models.errors import InputError
from weldcal.tools.console import Progress, plain
from weldcal.tools.farm.pools import in_this_process, on_dask, on_this_computer, processes_here

Result = dict[str, Any]
NAME = "tasks.jsonl"


class Journal:
    """The finished tasks of one study in a folder.

    The first line names the study; a last line that is cut off does not count.

    Raises:
        InputError: the folder holds the tasks of another study.
    """

    def __init__(self, folder: Path, study: Mapping[str, object]) -> None:
        self._path = folder / NAME
        self._found: dict[str, Result] = {}
        head = json.dumps(plain(study), sort_keys=True, allow_nan=False)
        lines = self._path.read_bytes().split(b"\n")[:-1] if self._path.exists() else []
        if lines and lines[0].decode("utf-8", "replace") != head:
            raise InputError(
                f"'{self._path}' holds the tasks of another study or of another version of weldcal. "
                "Give another folder with --out."
            )
        for line in lines[1:]:
            entry = json.loads(line)
            self._found[_key(entry["task"], entry["arguments"])] = entry["result"]
        folder.mkdir(parents=True, exist_ok=True)
        whole = sum(len(line) + 1 for line in lines)
        self._file = self._path.open("r+b" if self._path.exists() else "w+b")
        self._file.truncate(whole)
        self._file.seek(whole)
        if not lines:
            self._write(head)

    def result(self, task: str, arguments: Mapping[str, Any]) -> Result | None:
        """Return the result of a task with these arguments; None where it has not been finished."""
        return self._found.get(_key(task, arguments))

    def add(self, task: str, arguments: Mapping[str, Any], result: Result) -> None:
        """Keep a task's result on the disk."""
        text = json.dumps(plain({"task": task, "arguments": arguments, "result": result}), allow_nan=False)
        self._write(text)
        self._found[_key(task, arguments)] = json.loads(text)["result"]

    def close(self) -> None:
        """Close the file; a second call has no effect."""
        self._file.close()

    def _write(self, text: str) -> None:
        self._file.write(text.encode("utf-8") + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())


def _key(task: str, arguments: Mapping[str, Any]) -> str:
    return json.dumps(plain([task, arguments]), sort_keys=True)


@dataclass(frozen=True)
class Farm:
    """Hold where a study's tasks run and where their results are stored.

    Attributes:
        folder: of the study's results; a second run with the same folder does only what is missing.
        workers: processes on this computer; None: as many as its cores and memory allow; 0: in this process.
        scheduler: address of a Dask scheduler, in place of processes of this computer.
        progress: told which task was finished last, and the share done.
    """

    folder: Path
    workers: int | None = None
    scheduler: str | None = None
    progress: Progress = field(default=lambda stage, share: None, compare=False)

    @classmethod
    def of(cls, folder: Path, given: Mapping[str, Any], progress: Progress) -> Self:
        """Return the farm of a command's options --workers and --scheduler."""
        return cls(folder, given.get("workers"), given.get("scheduler"), progress)

    def run(
        self,
        function: Callable[..., Mapping[str, object]],
        tasks: Mapping[str, Mapping[str, Any]],
        each: Callable[[dict[str, Result]], None] | None = None,
    ) -> dict[str, Result]:
        """Call a module's function once per task with its keyword arguments.

        The results by task, in the order of ``tasks``.

        Args:
            function: of a module, so that another process finds it; it returns values that JSON can hold.
            tasks: keyword arguments by the task's name.
            each: called after every finished task with the results so far.

        Raises:
            InputError: the folder holds another study, or the scheduler cannot be reached. WorkerLost: a process has
                ended.
        """
        name = f"{function.__module__}:{function.__qualname__}"
        journal = Journal(self.folder, {"function": name, "software": software_version()})
        try:
            missing = {key: (name, given) for key, given in tasks.items() if journal.result(key, given) is None}
            finished = len(tasks) - len(missing)
            for key, result in self._computed(missing):
                journal.add(key, tasks[key], result)
                finished += 1
                self.progress(key, finished / len(tasks))
                if each is not None:
                    each(_finished(journal, tasks))
            return _finished(journal, tasks)
        finally:
            journal.close()

    def _computed(self, missing: Mapping[str, tuple[str, Mapping[str, Any]]]) -> Iterator[tuple[str, Result]]:
        if not missing:
            return iter(())
        if self.scheduler is not None:
            return on_dask(missing, self.scheduler)
        if self.workers == 0:
            return in_this_process(missing)
        return on_this_computer(missing, self.workers or processes_here())


def _finished(journal: Journal, tasks: Mapping[str, Mapping[str, Any]]) -> dict[str, Result]:
    found = ((key, journal.result(key, given)) for key, given in tasks.items())
    return {key: result for key, result in found if result is not None}
