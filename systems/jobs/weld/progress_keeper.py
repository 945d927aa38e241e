"""Keeps the progress of a weld on the disk while it runs, so that no end of the program loses more than 1 mm."""

import hashlib
import math
import os
import threading
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from weldcal.models.arrays import Array
from weldcal.models.files import write_apart
from weldcal.systems.jobs.weld.job import WeldJob
from weldcal.systems.jobs.weld.settings import seam_tool
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import PlannedSeam, SeamRecord
from weldcal.systems.runner import Run
from weldcal.welding.record.progress import CRATERS_NAME, Progress, Stretch
from weldcal.welding.servo.feel_start import mean_residual
from weldcal.welding.servo.state import Phase, WeldingState

RESTART: Final = "restart"
"""Folder of a result with the files of its scenario, from which the weld can go on."""
EVERY_M, EVERY_S = 1.0e-3, 0.5  # a choice: the points that a restart needs are felt long before
APART_M = 1.0e-3  # a choice: an arc that is lit so far behind the last one leaves a gap
CRATER_M = 0.1e-3  # a choice: a tenth of what a restart may be off along the seam
_BEHIND_M = 0.020  # twice the longest overlap: points that the torch may need again
_SPACING_M = 0.2e-3  # a choice: as a picture every 25 ms at the usual 8 mm/s
_FIRST = 8  # points: as many as the servo takes for what its plan is off
_LONGEST_LAG_M = 2.0e-3  # a choice: the farthest that friction has held a tip back
_NEAR_M = 5.0 * _LONGEST_LAG_M  # about its arc a felt point's place on the plan is looked for, not along the whole seam


def sha256_of(files: Mapping[str, bytes]) -> str:
    """The checksum of named files."""
    found = hashlib.sha256()
    for name in sorted(files):
        found.update(name.encode() + b"\0" + hashlib.sha256(files[name]).digest())
    return found.hexdigest()


class ProgressKeeper:
    """Looks at a run that welds, and writes its progress by threads of its own: the run does not wait for the disk.

    The result folder gets `progress.json` and the folder `restart` when the arm goes to the first seam. A second thread
    appends the place of the burning arc to `craters.jsonl`, for the other file is rewritten too slowly.
    """

    def __init__(self, folder: Path, files: Mapping[str, bytes], begun: Progress) -> None:
        """Prepare; nothing is written.

        Args:
            folder: of the result.
            files: the scenario's, by name.
            begun: the progress at the start, whose last end is that of this run.
        """
        self._folder, self._files, self._progress = folder, files, begun
        self._from_m, self._to_m, self._at, self._time = math.nan, -math.inf, -math.inf, -math.inf
        self._plan, self._ended, self._lit = (0, 0, 0, 0), (0, 0, 0, 0), False
        self._line_on, self._begun = SeamRecord(seam=0), ""
        self._slot: tuple[Progress, WeldingState | None] | None = None
        self._state: WeldingState | None = None
        self._line, self._line_m = "", -math.inf
        self._changed, self._closing = threading.Condition(), False
        self._threads: tuple[threading.Thread, ...] = ()
        self._problem: Exception | None = None

    @property
    def progress(self) -> Progress:
        """The newest progress, without its points."""
        return self._progress

    def look(self, run: Run[WeldJob]) -> None:
        """See run_cell."""
        job, root = run.cell.job, run.root
        phase = job.command(root).phase
        if not self._threads:
            if phase in ("confirm", "approach_above"):
                work = {"progress": self._write, "craters": self._append}
                self._threads = tuple(threading.Thread(target=w, name=n, daemon=True) for n, w in work.items())
                for thread in self._threads:
                    thread.start()
                self._put(None)
            return
        report, planned = job.servo_report(root), job.planned_seam(root)
        key = (*planned.key, planned.weld_pass)
        if (*report.plan_key, report.weld_pass) != key or planned.seam is None:
            return
        if key != self._plan:
            self._plan, self._from_m, self._to_m, self._at = key, math.nan, -math.inf, -math.inf
            self._line_on = (SeamRecord(seam=0, line=planned.seam, begins_m=planned.begins_m), *planned.records)[-1]
            self._line_m = -math.inf
        state = report.state
        lit = phase == "weld" and report.torch_on and state is not None and state.arc_seen
        if state is not None and (lit or self._lit):
            self._burning(report, state, planned, run, lit)
        if report.phase == Phase.DONE and self._ended != self._plan and math.isfinite(self._from_m):
            self._ended = self._plan
            self._finished(planned, run)
        self._lit = lit

    def _burning(
        self, report: ServoReport, state: WeldingState, planned: PlannedSeam, run: Run[WeldJob], lit: bool
    ) -> None:
        assert report.X_BT is not None
        assert state.plan_fit is not None
        p_BCrater = np.asarray(report.X_BT @ seam_tool(run.cell.scenario, run.cell.station, run.command.seam).p_TW)
        # while the tool stands for its arc, s_torch is the place where it began to come to rest
        s = state.plan_fit.curve.nearest(p_BCrater, state.s_torch)
        if math.isnan(self._from_m) or (lit and not self._lit and s > self._to_m + APART_M):
            self._from_m, self._begun = s, datetime.now(UTC).isoformat(timespec="milliseconds")
        if lit and s > self._to_m:
            self._to_m = s
            self._progress = replace(self._progress, p_BCrater=p_BCrater)
            if s > self._line_m + CRATER_M:
                self._line_m = s
                with self._changed:
                    self._line = self._stretch(run, done=False).line(p_BCrater)
                    self._changed.notify_all()
        late = run.seconds - self._time > EVERY_S and s > self._at
        if lit != self._lit or s > self._at + EVERY_M or late:
            seam, piece = run.command.seam, run.command.piece
            found = self._progress
            if (found.seam, found.piece) != (seam, piece) or found.X_BP is None or not found.stretches:
                X_BP = None if planned.X_BP is None else planned.X_BP.GetAsMatrix4()
                found = replace(found, seam=seam, piece=piece, X_BP=X_BP, sigma_m=planned.part_sigma_m)
            if found.p_BBegin is None:
                found = replace(found, p_BBegin=p_BCrater)
            self._progress = found.with_stretch(self._stretch(run, done=False))
            self._at, self._time = s, run.seconds
            self._put(state)

    def _finished(self, planned: PlannedSeam, run: Run[WeldJob]) -> None:
        command, found = run.command, self._progress.with_stretch(self._stretch(run, done=True))
        order = run.cell.job.travel.order
        later = (*order[order.index(command.seam) + 1 :], len(order))
        seam, piece = (command.seam, command.piece + 1) if planned.more else (later[0], 0)
        done = seam >= len(order)
        if command.weld_pass + 1 < run.cell.job.passes and not planned.more:
            seam, piece, done = command.seam, command.piece, False
        self._progress = replace(found, seam=seam, piece=piece, done=done, p_BCrater=None, p_BBegin=None, felt=None)
        self._put(None)

    def _stretch(self, run: Run[WeldJob], done: bool) -> Stretch:
        return Stretch(
            seam=run.command.seam,
            piece=run.command.piece,
            weld_pass=run.command.weld_pass,
            run=len(self._progress.ends) - 1,
            from_m=float(self._line_on.place(self._from_m)),
            to_m=float(self._line_on.place(max(self._to_m, self._from_m))),
            done=done,
            begun=self._begun,
            time=datetime.now(UTC).isoformat(timespec="milliseconds"),
        )

    def _put(self, state: WeldingState | None) -> None:
        self._state = state
        with self._changed:
            self._slot = self._progress, state
            self._changed.notify_all()

    def close(self, run: Run[WeldJob] | None = None) -> None:
        """Write the newest progress, that of a run's end where it has one, and end the thread.

        Raises:
            OSError: the disk took no progress.
        """
        if run is not None:
            self._progress = replace(self._progress, ends=(*self._progress.ends[:-1], run.reason or "done"))
        if not self._threads:
            return
        if run is not None and run.interrupted is not None and self._lit:
            self._at = -math.inf
            self.look(run)
        if run is not None:
            self._put(self._state)
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        if self._problem is not None:
            raise self._problem

    def _append(self) -> None:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with (self._folder / CRATERS_NAME).open("w") as file:
                while True:
                    with self._changed:
                        self._changed.wait_for(lambda: self._line or self._closing)
                        line, self._line = self._line, ""
                    if not line:
                        return
                    file.write(line)
                    file.flush()
                    os.fsync(file.fileno())
        except Exception as problem:  # as _write
            self._problem = problem

    def _write(self) -> None:
        try:
            for name, data in self._files.items():
                write_apart(self._folder / RESTART / name, data)
            while True:
                with self._changed:
                    while self._slot is None and not self._closing:
                        self._changed.wait()
                    slot, self._slot = self._slot, None
                if slot is None:
                    return
                progress, state = slot
                if state is not None:
                    progress = replace(progress, felt=felt_points(state))
                progress.write(self._folder)
        except Exception as problem:  # the run must not end by it: the arc burns
            self._problem = problem


def felt_points(state: WeldingState) -> Array | None:
    """The points (N, 4) m in B that were felt from a little behind the torch on, and their lag; None without any.

    Before the first one stand points of the path that the torch followed there: the plan, as far off as the first ones.
    """
    seam = state.refined
    if state.plan_fit is None or not len(seam):
        return None
    curve = state.plan_fit.curve
    keep = np.flatnonzero(seam.arc > state.torch_arc - _BEHIND_M)
    if not len(keep):
        return None
    spaced = [int(keep[0])]
    for k in keep[1:].tolist():
        if seam.arc[k] - seam.arc[spaced[-1]] >= _SPACING_M:
            spaced.append(k)
    points, arc = seam.points[spaced], seam.arc[spaced]
    near = curve.project(points, arc, _NEAR_M)
    lag = np.clip(arc - near, 0.0, _LONGEST_LAG_M)
    rows = np.column_stack([points, lag])
    if keep[0] > 0:
        return rows
    s = np.arange(max(state.s_torch - _BEHIND_M, 0.0), float(near[0]) - _SPACING_M, _SPACING_M)
    aside, above = mean_residual(seam.points[:_FIRST], curve, float(s[-1])) if len(s) else (0.0, 0.0)
    before = curve.position(s) + aside * curve.normal(s) + above * curve.up(s)
    return np.vstack([np.column_stack([before, np.full(len(s), lag[0])]), rows])
