"""One run of a scenario's job, whichever it is: choose the robot, build the cell, show it, run it; for every command that runs one."""

import time
import webbrowser
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydrake.geometry import Meshcat, MeshcatParams

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.jobs.discovery import job_of
from weldcal.systems.runner import Progress, Run, run_cell
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.commands.robots import chosen_robot
from weldcal.tools.outcomes.options import RunOptions
from weldcal.tools.report.render import write_atomic


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run that ended, done or held; the viewer that recorded it, where there is one; what moved, for a person."""

    run: Run[Any]
    meshcat: Meshcat | None
    robot: str

    @property
    def cell(self) -> Cell[Any]:
        """The cell that ran."""
        return self.run.cell

    def write_recording(self, folder: Path) -> None:
        """Write recording.html, where there is a recording."""
        if self.meshcat is not None:
            write_atomic(folder / "recording.html", self.meshcat.StaticHtml())


def run_job(scenario: Scenario, options: RunOptions, progress: Progress, key: str | None = None) -> FinishedRun:
    """Build the cell and run its job to the end; `key` is that of the job that the scenario must describe, None: any.

    Raises:
        InputError: it is another job. UnreachableScanner, RobotRefused: see chosen_robot and build_cell; nothing has been written or moved.
    """
    found = job_of(scenario).key
    if key and found != key:
        raise InputError(f"This scenario has no {key} part: write {key}: {{}} in it, or run it with weldcal demo.")
    if key is not None and found != key:
        raise InputError(f"This scenario has a {found} part, so there is no weld in it: run it with weldcal demo.")
    if options.speed_factor is not None:
        scenario.job.speed_factor = options.speed_factor
        check_scenario(scenario)
    progress("build the cell", 0.0)
    meshcat = None
    with chosen_robot(options.robot, scenario, dry_run=options.dry_run, pace=options.pace) as robot:
        if options.recording or options.browser:
            meshcat = Meshcat(MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}"))
        cell = build_cell(scenario, options.seed, meshcat, robot.prepared)
        with closing(cell.station):
            if meshcat is not None:
                _set_the_scene(meshcat, *cell.job.view())
                if options.browser:
                    webbrowser.open(meshcat.web_url())
                    time.sleep(2.0 if options.realtime else 0.5)  # the page wants a moment before the story begins
            run = run_cell(cell, progress, meshcat, options.realtime)
    return FinishedRun(run, meshcat, robot.title)


def _set_the_scene(meshcat: Meshcat, camera: Array, target: Array) -> None:
    """A calm background and a viewer who stands in front of the job."""
    meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.78, 0.82, 0.86])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetCameraPose(camera, target)
