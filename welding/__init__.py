"""Locating, following and recording a weld seam, without Drake systems."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.welding.finger.calibration import TipCalibration, calibrate_tip
    from weldcal.welding.finger.deformation import TagModel, TagObservation, detect_tag
    from weldcal.welding.locate.groove.extract import extract_groove
    from weldcal.welding.locate.groove.seam import GrooveConfig, GrooveNotFound, GrooveSeam
    from weldcal.welding.locate.part.model import PartModel
    from weldcal.welding.locate.part.registration import register_part
    from weldcal.welding.locate.part.result import PartConfig, PartNotFound, PartRegistration
    from weldcal.welding.passes.bead import bead_area, propose_passes
    from weldcal.welding.passes.felt import PassError, WeldPass
    from weldcal.welding.record.weld_log import WeldRecord, load_weld_log
    from weldcal.welding.seam.curve import SeamCurve, SeamError
    from weldcal.welding.seam.feasibility import InfeasibleSeam, SeamReport, assess_seam, split_seam
    from weldcal.welding.servo.settings import ServoConfig
    from weldcal.welding.servo.state import DeflectionSample, Phase, ServoSample, WeldingCommand, WeldingState
    from weldcal.welding.servo.step import welding_step
else:
    from weldcal.models import exported

    __getattr__, __dir__ = exported(__name__)

__all__ = [
    "DeflectionSample",
    "GrooveConfig",
    "GrooveNotFound",
    "GrooveSeam",
    "InfeasibleSeam",
    "PartConfig",
    "PartModel",
    "PartNotFound",
    "PartRegistration",
    "PassError",
    "Phase",
    "SeamCurve",
    "SeamError",
    "SeamReport",
    "ServoConfig",
    "ServoSample",
    "TagModel",
    "TagObservation",
    "TipCalibration",
    "WeldPass",
    "WeldRecord",
    "WeldingCommand",
    "WeldingState",
    "assess_seam",
    "bead_area",
    "calibrate_tip",
    "detect_tag",
    "extract_groove",
    "load_weld_log",
    "propose_passes",
    "register_part",
    "split_seam",
    "welding_step",
]
