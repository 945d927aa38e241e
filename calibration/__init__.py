"""The mathematics of where things are: flange fit, rigid solvers, verification."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.calibration.calibrate import Calibration as Calibration, Steps as Steps
    from weldcal.calibration.data.dataset import Dataset as Dataset, load_dataset as load_dataset
    from weldcal.calibration.data.results import (
        CalibrationResult as CalibrationResult,
        load_result as load_result,
        save_result as save_result,
    )
    from weldcal.calibration.data.scanner_correction import ScannerCorrection as ScannerCorrection
    from weldcal.calibration.errors import (
        CoplanarPoses as CoplanarPoses,
        DatasetError as DatasetError,
        FlangeNotFound as FlangeNotFound,
        InconsistentPoses as InconsistentPoses,
        RepeatedPoses as RepeatedPoses,
        ScannerMoved as ScannerMoved,
        TooFewPoses as TooFewPoses,
        UnreachableScanner as UnreachableScanner,
    )
    from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate as CalibrationEstimate
    from weldcal.calibration.eye_on_base.observations import (
        FlangeObservations as FlangeObservations,
        fit_flanges as fit_flanges,
    )
    from weldcal.calibration.flange.fit import FlangeFit as FlangeFit, fit_flange as fit_flange
    from weldcal.calibration.flange.observation import (
        Observation as Observation,
        observation_from_fit as observation_from_fit,
    )
    from weldcal.calibration.hand_eye.solve import (
        HandEyeConfig as HandEyeConfig,
        HandEyeResult as HandEyeResult,
        solve_ax_xb as solve_ax_xb,
        solve_ax_yb as solve_ax_yb,
        solve_axb_ycz as solve_axb_ycz,
    )
    from weldcal.calibration.planning.calibration_poses import (
        PlannedPose as PlannedPose,
        PlannerConfig as PlannerConfig,
        plan_calibration_poses as plan_calibration_poses,
    )
else:
    from weldcal.models import exported

    __getattr__, __dir__ = exported(__name__)
