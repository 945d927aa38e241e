"""The main uses of weldcal as Python functions; `import weldcal` has all of them."""

import tempfile
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform

from weldcal.calibration.data import clouds
from weldcal.calibration.data.checks import AUTO, UNITS, cloud_unit
from weldcal.calibration.data.poses.names import mounting_name
from weldcal.calibration.data.results import CalibrationResult, load_result
from weldcal.calibration.flange import fit as flange_fit
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.hand_eye.solve import HandEyeResult, as_poses
from weldcal.calibration.recorded_flange import FlangeOptions
from weldcal.calibration.recorded_hand_eye import solve_arrays
from weldcal.calibration.verified_pairs import PairsOptions, holds_scans
from weldcal.calibration.verified_scans import VerifyOptions
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.systems.cell import Cell
from weldcal.systems.cell import build_cell as build
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.wiring import Replacement
from weldcal.tools.procedure import run_procedure
from weldcal.tools.recorded import calibrate_dataset
from weldcal.tools.report.calibration import CalibrationReport
from weldcal.tools.report.run import RunOptions
from weldcal.tools.report.verify import VerifyReport
from weldcal.tools.report.verify_pairs import PairsReport
from weldcal.tools.verified import verify_dataset, verify_on_pairs

Floats = npt.NDArray[np.floating[Any]]
FLANGE = "iso9409-1-50-4-m6"

__all__ = [
    "build_cell",
    "calibrate",
    "fit_flange",
    "hand_eye",
    "load_scenario",
    "read_calibration",
    "read_cloud",
    "run",
    "verify",
]


def calibrate(
    folder: str | Path,
    out: str | Path | None = None,
    *,
    robot: str | None = None,
    flange: str | None = None,
    correct_scanner: bool = True,
    seed: int = 0,
) -> CalibrationReport:
    """Calibrate a scanner from a folder of flange scans and robot poses; see docs/calibration.md for the folder.

    Args:
        folder: the dataset.
        out: folder for calibration.yaml, its exports and report.html; None: nothing is kept.
        robot, flange: in place of those in dataset.yaml.
        correct_scanner: estimate and apply a correction of the scanner's own errors.

    Returns:
        `.result.X_BC` (pose of the camera in the robot's base, m), `.result.covariance` (6, 6), `.result.held_out_mm`,
        and more.

    Raises:
        InputError, TooFewPoses: the data cannot be used; the message says what to change.
    """
    asked = FlangeOptions(robot=robot, flange=flange, correct_scanner=correct_scanner, seed=seed)
    with _folder(out) as kept:
        return calibrate_dataset(Path(folder), Path(kept), asked)


def _folder(out: str | Path | None) -> AbstractContextManager[str | Path]:
    """Return the folder of a result; None: one that is deleted again."""
    return tempfile.TemporaryDirectory() if out is None else nullcontext(out)


def verify(
    result: str | Path,
    folder: str | Path,
    out: str | Path | None = None,
    *,
    limit_mm: float | None = None,
    flange: str | None = None,
    mounting: str | None = None,
) -> VerifyReport | PairsReport:
    """Verify a calibration on scans, or any file with a camera's pose on pairs of poses, that it did not use.

    Args:
        result: what `calibrate` wrote (its folder, or calibration.yaml); for pairs any file with a pose.
        folder: a dataset with scans of the flange, or a file or folder with pairs as `weldcal hand-eye` reads.
        out: folder for verification.json and report.html; None: nothing is kept.
        limit_mm: largest acceptable error; None: what the calibration states, or the pairs show, decides.
        flange: of the scans; None: as the dataset or the result names it.
        mounting: of the pairs, where neither they nor the result name it.

    Raises:
        InputError: the result or the data cannot be used.
    """
    if not holds_scans(Path(folder)):
        known, there = PairsOptions(mounting=mounting), None if out is None else Path(out)
        return verify_on_pairs(Path(result), Path(folder), there, known, limit_mm=limit_mm)
    asked = VerifyOptions(limit_mm=limit_mm, flange=flange)
    with _folder(out) as kept:
        return verify_dataset(Path(result), Path(folder), Path(kept), asked)


def read_cloud(file: str | Path, unit: str = "auto") -> Floats:
    """Points (N, 3), or organised (H, W, 3) with NaN where invalid, in metres, of a PLY, PCD, NPZ, NPY or text
    file or a depth image beside a file of its camera.

    Args:
        unit: of the file's numbers, m or mm; auto is the one in which the points lie 10 mm to 10 m from the camera
            (median), as `weldcal calibrate` and `weldcal apply` read a file.

    Raises:
        CloudError: the file cannot be read, or neither unit fits. InputError: another unit.
    """
    if unit not in (AUTO, *UNITS):
        raise InputError(f"The unit of a cloud must be auto, m or mm, not '{unit}'.")
    points = clouds.read_cloud(Path(file))
    return UNITS[cloud_unit(points, Path(file).name) if unit == AUTO else unit] * points


def read_calibration(file: str | Path) -> CalibrationResult:
    """Read a calibration: the folder that `calibrate` wrote, or its calibration.yaml.

    Returns:
        `.X_BC` (X_FC of a scanner on the flange has the same name), `.covariance` (6, 6); `.correct(points_C)` corrects
        scanned points.

    Raises:
        InputError: there is no calibration, or it cannot be read.
    """
    return load_result(Path(file))


def fit_flange(points_C: Floats, flange: str = FLANGE) -> FlangeFit:
    """Find a robot's flange in a scan (N, 3), or organised (H, W, 3) with NaN where invalid; metres, camera frame.

    Returns:
        `.center_C` (3,) m, `.normal_C` (3,), their covariances, and what of the edge was seen.

    Raises:
        FlangeNotFound: it is not there, or too little of it is seen. InputError: an unknown designation.
    """
    return flange_fit.fit_flange(np.asarray(points_C), get_flange(flange))


def hand_eye(
    robot: Floats,
    camera: Floats,
    mounting: str = "eye_in_hand",
    *,
    robot_form: str | None = None,
    camera_form: str | None = None,
) -> HandEyeResult:
    """Calibrate a camera from pairs of poses (AX = XB, AX = YB).

    Args:
        robot: X_BF (n, 4, 4), the robot's flange in its base; camera: X_CM (n, 4, 4), the target in the camera; metres.
        mounting: eye_in_hand or eye_on_base, and others of `weldcal hand-eye`.
        robot_form, camera_form: how the matrices are to be read, as the keys robot-form and camera-form of the command:
            matrix, or "matrix,inverse".

    Returns:
        `.poses` by letter (X: the camera on what carries it, Y: the target), `.covariance`, `.held_out`,
        `.unobservable`. `.warnings` name another reading of the matrices than the usual one, and the rows that were
        left out.

    Raises:
        InputError: poses that cannot be used, contradict each other, or do not determine the answer.
    """
    A, B = (
        np.array([X.GetAsMatrix4() if isinstance(X, RigidTransform) else X for X in each]) for each in (robot, camera)
    )
    if any(each.ndim != 3 or each.shape[1:] != (4, 4) for each in (A, B)) or len(A) != len(B):
        raise InputError(f"robot and camera must both be (n, 4, 4) matrices; they are {A.shape} and {B.shape}.")
    A, B = as_poses(A, "robot"), as_poses(B, "camera")
    return solve_arrays(A, B, mounting_name(mounting), robot_form, camera_form)


def build_cell(
    scenario: Scenario | str,
    seed: int = 0,
    meshcat: Meshcat | None = None,
    *,
    replace: Mapping[str, Replacement] | None = None,
) -> Cell[Any]:
    """Build the Drake Diagram of a scenario (or of its name or path); close its `.station` after use.

    Args:
        meshcat: viewer of the cell; None: no viewer.
        replace: makes systems that replace systems of the job, by name; each gets that system and the station.

    Returns:
        `.diagram`; `.plant` and `.scene_graph` of its simulation, finalized; `.logs`, the VectorLogSinks by name.

    Raises:
        InputError, UnreachableScanner: the scenario cannot be run, or `replace` does not fit the job.
    """
    return build(load_scenario(scenario) if isinstance(scenario, str) else scenario, seed, meshcat, replace=replace)


def run(
    scenario: str,
    out: str | Path,
    seed: int = 0,
    *,
    recording: bool = True,
    replace: Mapping[str, Replacement] | None = None,
) -> dict[str, object]:
    """Run the job of a scenario (name or path) and write its result folder, as `weldcal demo` does; returns its
    summary.

    Args:
        recording: write recording.html.
        replace: see build_cell.

    Raises:
        InputError, UnreachableScanner, RobotRefused: the scenario cannot be run; nothing has been written or moved.
    """
    options = RunOptions(scenario=scenario, out=Path(out), seed=seed, recording=recording, replace=replace)
    return dict(run_procedure(options, lambda stage, fraction: None).summary())
