"""The mathematics of where things are: flange fit, rigid solvers, verification."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.calibration.calibrate import Calibration, Steps
    from weldcal.calibration.data.dataset import Dataset, load_dataset
    from weldcal.calibration.data.results import CalibrationResult, load_result, save_result
    from weldcal.calibration.data.scanner_correction import ScannerCorrection
    from weldcal.calibration.errors import (
        CoplanarPoses,
        DatasetError,
        FlangeNotFound,
        InconsistentPoses,
        RepeatedPoses,
        ScannerMoved,
        TooFewPoses,
        UnreachableScanner,
    )
    from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate
    from weldcal.calibration.eye_on_base.observations import FlangeObservations, fit_flanges
    from weldcal.calibration.flange.fit import FlangeFit, fit_flange
    from weldcal.calibration.flange.observation import Observation, observation_from_fit
    from weldcal.calibration.hand_eye.solve import HandEyeConfig, HandEyeResult, solve_ax_xb, solve_ax_yb, solve_axb_ycz
    from weldcal.calibration.planning.calibration_poses import PlannedPose, PlannerConfig, plan_calibration_poses
else:
    from weldcal.models import exported

    __getattr__, __dir__ = exported(__name__)

__all__ = [
    "Calibration",
    "CalibrationEstimate",
    "CalibrationResult",
    "CoplanarPoses",
    "Dataset",
    "DatasetError",
    "FlangeFit",
    "FlangeNotFound",
    "FlangeObservations",
    "HandEyeConfig",
    "HandEyeResult",
    "InconsistentPoses",
    "Observation",
    "PlannedPose",
    "PlannerConfig",
    "RepeatedPoses",
    "ScannerCorrection",
    "ScannerMoved",
    "Steps",
    "TooFewPoses",
    "UnreachableScanner",
    "fit_flange",
    "fit_flanges",
    "load_dataset",
    "load_result",
    "observation_from_fit",
    "plan_calibration_poses",
    "save_result",
    "solve_ax_xb",
    "solve_ax_yb",
    "solve_axb_ycz",
]
