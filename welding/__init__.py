"""Locating, following and recording a weld seam, without Drake systems."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from weldcal.welding.finger.calibration import TipCalibration as TipCalibration, calibrate_tip as calibrate_tip
    from weldcal.welding.finger.deformation import (
        TagModel as TagModel,
        TagObservation as TagObservation,
        detect_tag as detect_tag,
    )
    from weldcal.welding.locate.groove.extract import extract_groove as extract_groove
    from weldcal.welding.locate.groove.seam import (
        GrooveConfig as GrooveConfig,
        GrooveNotFound as GrooveNotFound,
        GrooveSeam as GrooveSeam,
    )
    from weldcal.welding.locate.part.model import PartModel as PartModel
    from weldcal.welding.locate.part.registration import register_part as register_part
    from weldcal.welding.locate.part.result import (
        PartConfig as PartConfig,
        PartNotFound as PartNotFound,
        PartRegistration as PartRegistration,
    )
    from weldcal.welding.passes.angles import AnglesAlong as AnglesAlong
    from weldcal.welding.passes.bead import bead_area as bead_area, propose_passes as propose_passes
    from weldcal.welding.passes.felt import PassError as PassError, WeldPass as WeldPass
    from weldcal.welding.record.schedule import GapAlong as GapAlong
    from weldcal.welding.record.weld_log import WeldRecord as WeldRecord, load_weld_log as load_weld_log
    from weldcal.welding.seam.curve import SeamCurve as SeamCurve, SeamError as SeamError
    from weldcal.welding.seam.feasibility import (
        InfeasibleSeam as InfeasibleSeam,
        SeamReport as SeamReport,
        assess_seam as assess_seam,
        split_seam as split_seam,
    )
    from weldcal.welding.servo.interruption import Interruption as Interruption
    from weldcal.welding.servo.settings import ServoConfig as ServoConfig
    from weldcal.welding.servo.state import (
        DeflectionSample as DeflectionSample,
        Diagnostics as Diagnostics,
        Phase as Phase,
        ServoSample as ServoSample,
        WeldingCommand as WeldingCommand,
        WeldingState as WeldingState,
    )
    from weldcal.welding.servo.step import welding_step as welding_step
else:
    from weldcal.models import exported

    __getattr__, __dir__ = exported(__name__)
