"""Good sessions of `weldcal capture`: whether a capture is refused or named without cause, and what X is off."""

import tempfile
import time
from pathlib import Path

import numpy as np

from tests.figures.harness import Run, figure
from weldcal.calibration.capture.carried import CarriedTask
from weldcal.calibration.capture.session import CaptureSession, CaptureTask
from weldcal.calibration.capture.tasks import FlangeTask
from weldcal.models.arms.kinematics import load_arm
from weldcal.systems.jobs.mounting.job import mounting_plan, mounting_scene
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.dashboard.capture_demo import ROBOT, DemoCell

CAPTURES = 8
FIRST = ("+x", "+ry", "+y", "-rx", "-z", "+rx", "-x", "-ry")


def cell_and_task(mounting: str, seed: int) -> tuple[DemoCell, CaptureTask]:
    """An emulated cell of a scenario that has a carried scanner, or of one beside the arm ("")."""
    if not mounting:
        return DemoCell(seed), FlangeTask(ROBOT, "ISO 9409-1-50-4-M6")
    scenario = load_scenario(mounting)
    header, scene, circle = mounting_scene(scenario, load_arm(scenario.arm))
    return DemoCell(seed, scene), CarriedTask(header, scene, circle, mounting_plan(scenario, seed))


@figure("capture-sessions", "good sessions of capture: refusals, wrong names, errors and times")
def capture_sessions(run: Run) -> None:
    """Follow the advice for eight captures in each of many cells."""
    rows = []
    for mounting, words in (("", "beside the arm"), ("eye_in_hand", "on the flange"), ("eye_on_arm", "on the forearm")):
        seeds = run.seeds(2, 30 if not mounting else 10)
        refused, named, inside, errors, stated, waits = 0, 0, 0, [], [], []
        for seed in seeds:
            cell, task = cell_and_task(mounting, seed)
            with tempfile.TemporaryDirectory() as scratch:
                one = CaptureSession(Path(scratch) / "captures", task)
                verdict, tries = one.verdict(), 0
                while len(one.captures) < CAPTURES and tries < 2 * CAPTURES:
                    cell.jog("next" if verdict.advice else FIRST[tries % len(FIRST)], verdict.advice)
                    scan, began = cell.take(Path(scratch)), time.monotonic()
                    refused += bool(one.take(scan, cell.pose()).refused)
                    verdict = one.verdict()
                    waits.append(time.monotonic() - began)
                    named += len(verdict.odd)
                    tries += 1
            if verdict.X is None or verdict.error_95_m is None:
                continue
            work = np.array([0.0, 0.0, 0.7])
            errors.append(1e3 * float(np.linalg.norm(verdict.X @ work - cell.X_LC @ work)))
            stated.append(1e3 * verdict.error_95_m)
            inside += errors[-1] < stated[-1]
        n = str(len(seeds))
        figures = f"{np.median(errors):.3f}", f"{np.median(stated):.3f}", f"{np.percentile(waits, 95):.1f}"
        rows.append((words, n, str(refused), str(named), f"{inside} of {n}", *figures))
    heads = (
        "the scanner is",
        "sessions",
        "refused",
        "named",
        "inside",
        "error, mm",
        "stated (95 %), mm",
        "wait, s (95 %)",
    )
    run.table("", heads, rows)
