"""Reads a broken weld from its result folder, and keeps the progress of one that runs."""

import dataclasses as dc
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from weldcal.models.errors import InputError
from weldcal.systems.jobs.weld.progress_keeper import RESTART, ProgressKeeper, sha256_of
from weldcal.systems.jobs.weld.seam_planner import SeamPlanner
from weldcal.systems.jobs.weld.sequencer import JobSequencer
from weldcal.systems.recording.scenario_files import SCENARIO, packed
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Replacement
from weldcal.tools.cli.options import option
from weldcal.tools.report.run import RunOptions
from weldcal.welding.record.progress import Progress, ProgressError, load_progress
from weldcal.welding.seam.restart import Restart

ResumeOption = Annotated[
    Path | None, option("--resume", "FOLDER", "Go on with the broken weld of this result folder, from its crater.")
]
OverlapOption = Annotated[
    float, option("--overlap-mm", "MM", "With --resume: the arc starts so far before the crater.", min=5.0, max=10.0)
]


@dc.dataclass(frozen=True, eq=False)
class BrokenWeld:
    """A broken weld: its progress, its scenario, and the options of the run that goes on with it."""

    progress: Progress
    scenario: Scenario
    options: Mapping[str, Any]


def broken_weld(folder: Path, overlap_mm: float, live: Mapping[str, Any]) -> BrokenWeld:
    """Read a broken weld; `live` are the options of a live run that were given.

    Raises:
        InputError: there is nothing to go on with, its files were changed, or nobody could answer the question.
    """
    progress = load_progress(folder)
    if progress.done:
        raise ProgressError(f"The weld in '{folder}' is complete: nothing is left to weld.")
    if progress.continued_in:
        raise ProgressError(f"The weld in '{folder}' has gone on in '{progress.continued_in}': resume that one.")
    files = {path.name: path.read_bytes() for path in (folder / RESTART).glob("*") if path.is_file()}
    if sha256_of(files) != progress.scenario_sha256:
        raise ProgressError(
            f"The scenario in '{folder / RESTART}' is not that of the broken weld: restore its files, or weld the rest"
            " by hand."
        )
    if not (live.get("browser") or sys.stdin.isatty()):
        raise InputError(
            "The arc of a restart starts only after an operator's yes, and nobody could give it: run the command in a"
            " terminal, or without --no-browser."
        )
    for name in ("record", "dry_run"):
        if live.get(name):
            raise InputError(f"A restart cannot be done with --{name.replace('_', '-')}: omit it.")
    options: dict[str, Any] = {"replace": restarting(progress.restart(1e-3 * overlap_mm))}
    if live.get("robot") is None:
        options["robot"] = progress.robot
    return BrokenWeld(progress, load_scenario(str(folder / RESTART / SCENARIO)), options)


def restarting(restart: Restart) -> dict[str, Replacement]:
    """The systems of a weld job that go on with a broken weld, for build_cell."""

    def planner(shipped: Any, station: Station) -> SeamPlanner:
        found: SeamPlanner = shipped.restarted(restart)
        return found

    def sequencer(shipped: Any, station: Station) -> JobSequencer:
        found: JobSequencer = shipped.begun_at(restart.seam, restart.piece)
        return found

    return {"seam_planner": planner, "job_sequencer": sequencer}


def keeper_of(scenario: Scenario, options: RunOptions, earlier: Progress | None = None) -> ProgressKeeper:
    """Keeps the progress of a run of this scenario; `earlier`: of the weld that it goes on with."""
    files, folder = packed(scenario), str(options.out.absolute())
    begun = earlier or Progress(
        scenario=options.scenario, seed=options.seed, robot=options.robot, scenario_sha256="", folders=()
    )
    begun = dc.replace(begun, scenario_sha256=sha256_of(files), folders=(*begun.folders, folder), robot=options.robot)
    return ProgressKeeper(options.out, files, begun)
