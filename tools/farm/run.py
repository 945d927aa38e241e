"""Runs a study's tasks on any number of workers: the same numbers to the last bit, in the order of the tasks."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from weldcal.calibration.data.results import software_version
from weldcal.tools.console import Progress
from weldcal.tools.farm.journal import Journal, Result
from weldcal.tools.farm.pools import in_this_process, on_dask, on_this_computer, processes_here


@dataclass(frozen=True)
class Farm:
    """Where a study's tasks run and where their results are kept.

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
        """The farm of a command's options --workers and --scheduler."""
        return cls(folder, given.get("workers"), given.get("scheduler"), progress)

    def run(
        self,
        function: Callable[..., Mapping[str, object]],
        tasks: Mapping[str, Mapping[str, Any]],
        each: Callable[[dict[str, Result]], None] | None = None,
    ) -> dict[str, Result]:
        """Call a module's function once per task with its keyword arguments; the results by task, in the order of
        ``tasks``.

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
