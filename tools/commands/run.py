"""Runs the job of a scenario for all commands: selects the robot, builds the cell, opens the viewer and advances it."""

import time
import webbrowser
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.jobs.discovery import job_of
from weldcal.systems.person import Person, person_at
from weldcal.systems.runner import Progress, Run, run_cell
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.viewer.kept import free_unused
from weldcal.systems.viewer.live import LiveView
from weldcal.tools import console
from weldcal.tools.commands.record import RunRecorder
from weldcal.tools.commands.robots import chosen_robot
from weldcal.tools.dashboard.facts import facts_of
from weldcal.tools.dashboard.recording import with_overlay
from weldcal.tools.dashboard.source import DashboardSource
from weldcal.tools.report.render import write_atomic
from weldcal.tools.report.run import RunOptions


@dataclass(frozen=True, eq=False)
class JobRun:
    """A completed run, done or held; its recording viewer, or None; the name of its robot; what was shown of it, or None."""

    run: Run[Any]
    meshcat: Meshcat | None
    robot: str
    live: LiveView | None = None

    @property
    def cell(self) -> Cell[Any]:
        """The cell that ran."""
        return self.run.cell

    def write_recording(self, folder: Path) -> None:
        """Write recording.html where the run was recorded."""
        if self.meshcat is not None:
            page = self.meshcat.StaticHtml()
            if self.live is not None:
                page = with_overlay(page, self.run, self.live, self.cell.scenario.description or "weldcal")
            write_atomic(folder / "recording.html", page)


def run_job(scenario: Scenario, options: RunOptions, progress: Progress, key: str | None = None) -> JobRun:
    """Build the cell and run its job to the end; `key` is the key of the required job, None: any job.

    Raises:
        InputError: the scenario has another job. UnreachableScanner, RobotRefused: see chosen_robot and build_cell; nothing has been written or moved.
    """
    found = job_of(scenario).key
    if key and found != key:
        raise InputError(f"This scenario has no {key} part: write {key}: {{}} in it, or run it with weldcal demo.")
    if key is not None and found != key:
        raise InputError(f"This scenario has a {found} part, so there is no weld in it: run it with weldcal demo.")
    if options.speed_factor is not None:
        scenario.job.speed_factor = options.speed_factor
        check_scenario(scenario)
    meshcat = None
    with (
        _one_thread(),
        chosen_robot(options.robot, scenario, dry_run=options.dry_run, pace=options.pace) as robot,
        person_at() as person,
    ):
        free_unused()
        if options.recording or options.browser:
            meshcat = Meshcat(
                MeshcatParams(host="localhost", web_url_pattern="http://{host}:{port}", show_stats_plot=False)
            )
        recorder = RunRecorder(scenario, options, robot.title) if options.record else None
        open_sink = None if recorder is None else recorder.open_sink
        with _dashboard(person, meshcat, options) as source:

            def told(stage: str, share: float) -> None:
                progress(stage, share)
                if source is not None:
                    source.stage(stage, share)

            def ended(finished: Run[Any]) -> None:
                if source is not None:
                    source.end(finished.held, finished.reason, replays=True)

            told("build the cell", 0.0)
            live = None if meshcat is None else LiveView() if source is None else source.live
            cell = build_cell(
                scenario, options.seed, meshcat, robot.prepared, open_sink=open_sink, person=person, live=live
            )
            with closing(cell.station):
                if meshcat is not None:
                    camera, target = cell.job.view()
                    _set_the_scene(meshcat, camera, target, scenario.base.pose())
                if source is not None:
                    source.facts = facts_of(cell, options.scenario, robot.title)
                run = run_cell(cell, told, meshcat, options.realtime, ended)
                if recorder is not None:
                    recorder.close(run)
    return JobRun(run, meshcat, robot.title, live)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let NumPy and OpenCV use one thread for the duration of the block.

    The products of a tick and the finger camera's pictures are small: a second thread waits busily for the next one and takes a
    core from the robot's peer.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def _dashboard(person: Person, meshcat: Meshcat | None, options: RunOptions) -> Iterator[DashboardSource | None]:
    """Serve the run's page for the duration of the block, and open it in the browser; None where no viewer is wanted."""
    if meshcat is None or not options.browser:
        yield None
        return
    from weldcal.tools.dashboard.server import Dashboard  # Flask takes a moment to load

    source = DashboardSource(LiveView(), person)
    with closing(Dashboard(source, meshcat.web_url(), options.share)) as dashboard:
        console.emit_address("dashboard", dashboard.url)
        if dashboard.shared_url is not None:
            console.emit_address("read-only for the network", dashboard.shared_url)
        webbrowser.open(dashboard.url)
        time.sleep(2.0 if options.realtime else 0.5)  # the page needs a moment to load
        try:
            yield source
        finally:
            if not source.ended:
                source.end(held=True, reason="The run has failed: the reason is in the terminal.", replays=False)


def _set_the_scene(meshcat: Meshcat, camera: Array, target: Array, X_WB: RigidTransform) -> None:
    """Set the background and the viewer's camera; everything is drawn in B, and shown as the base stands in the world."""
    if not X_WB.IsExactlyIdentity():
        meshcat.SetTransform("/drake", X_WB)
        camera, target = camera + X_WB.translation(), X_WB @ target
    meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.78, 0.82, 0.86])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetCameraPose(camera, target)
