"""Make the scans that `weldcal new FOLDER --dataset` copies: python -m tests.documents.example_scans [SEED].

The cell `calibrate_only` plans twelve poses and scans at them: a scanner with a scale error, gradients and a warp, an
arm with errors of its links and its repeatability. The truth is printed; TRUTH holds it for the tests.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydrake.math import RigidTransform

from tests.places import ROOT
from weldcal.calibration.data.dataset import load_dataset
from weldcal.systems.runner import no_progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.tools.commands.run import run_job
from weldcal.tools.commands.weld import write_scans
from weldcal.tools.report.run import RunOptions

PLACE = ROOT / "tools" / "commands" / "cell" / "example_scans"
SEED = 1
EVERY_SCAN = "calibration: {required_error_mm: 0.01}"  # no calibration is as good: the cell scans at all twelve poses
STEP_M = 1e-5  # of the depths, as scanners store them
FAR_M = 0.88  # the scanner's range ends above the table
TRUTH = np.array(
    [
        [-0.0016846, -0.99966081, -0.02598891, 0.63691103],
        [-0.99999504, 0.00175324, -0.00261822, -0.0072862],
        [0.0026629, 0.02598437, -0.9996588, 0.9492317],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""X_BC of the scanner that took these scans."""


def make(place: Path, seed: int) -> RigidTransform:
    """Write poses.csv and clouds/ to a folder, and return the true X_BC."""
    with TemporaryDirectory() as scratch:
        scenario = load_scenario("calibrate_only", EVERY_SCAN)
        options = RunOptions(scenario="calibrate_only", out=Path(scratch) / "run", seed=seed, recording=False)
        finished = run_job(scenario, options, no_progress, "")
        status = finished.cell.job.calibration_status(finished.run.root)
        folder = write_scans(finished.run, status, Path(scratch) / "scans")
        assert folder is not None
        data = load_dataset(folder)
        (place / "clouds").mkdir(parents=True, exist_ok=True)
        rows = ["id,x,y,z,qw,qx,qy,qz"]
        for k, (id, path) in enumerate(data.clouds.items(), start=1):
            X = data.poses[id]
            numbers = (*X.translation(), *X.rotation().ToQuaternion().wxyz())
            rows.append(f"pose{k:02d}," + ",".join(f"{v:.7f}" for v in numbers))
            with np.load(path) as cloud:
                depth, intrinsics = cloud["depth"].astype(float), cloud["intrinsics"]
            depth = np.where(depth < FAR_M, STEP_M * np.round(depth / STEP_M), np.nan).astype(np.float32)
            np.savez_compressed(place / "clouds" / f"pose{k:02d}.npz", depth=depth, intrinsics=intrinsics)
        (place / "poses.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    truth = finished.cell.station.truth.X_BC
    assert truth is not None
    return truth


if __name__ == "__main__":
    print(repr(make(PLACE, int(sys.argv[1]) if len(sys.argv) > 1 else SEED).GetAsMatrix4()))
