"""The touch job: one scan of the part, then the soft tip touches flat places beside its groove."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.calibration.data.results import CalibrationResult, load_result
from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.touch.touches import PLANE, Touch
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import FingerCameraConfig
from weldcal.systems.jobs.job import AddedJob, Job, Phases
from weldcal.systems.jobs.touch.planner import TouchConfig, TouchPlanner, TouchPlanning, check_touch
from weldcal.systems.jobs.touch.procedure import Felt, TouchMotion, TouchProcedure, TouchState
from weldcal.systems.jobs.weld.aruco_deformation_estimator import ArucoDeformationEstimator
from weldcal.systems.jobs.weld.job import seam_planning
from weldcal.systems.jobs.weld.settings import servo_config
from weldcal.systems.motion.spine import MOVE_TIMEOUT_S, Spine
from weldcal.systems.phase_words import TOUCH_STEPS, phase_words
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import Station
from weldcal.systems.wiring import Wiring

TOUCHING = dict(TOUCH_STEPS)["Touch"]
"""Phases at a place."""


@dataclass(eq=False, kw_only=True)
class AddedTouches(AddedJob):
    """The systems of the job, and the calibration that it judges."""

    result: CalibrationResult
    station: Station
    points: int
    procedure: TouchProcedure

    def stage(self, root: Context, phases: Phases) -> tuple[str, float]:
        """See AddedJob."""
        state: TouchState = self.state(root)
        at = f"place {state.index + 1} of {self.points}" if state.phase in TOUCHING else ""
        return phase_words(state.phase, at), 0.95 if state.finished else 0.1 + 0.8 * len(state.felt) / self.points

    def touches(self, root: Context) -> tuple[Touch, ...]:
        """Return the touches so far: pressed position of the tip, its ball less its deflection, the scan's plane."""
        return tuple(self._touch(f"touch{k + 1:02d}", felt) for k, felt in enumerate(self.state(root).felt))

    def height_m(self, felt: Felt) -> float:
        """How far (m) the touched face lies above the scanned one, with the calibration that is judged."""
        touch = self._touch("", felt)
        return float((touch.p_BT - felt.place.p_B) @ felt.place.n_B) - touch.radius

    def _touch(self, name: str, felt: Felt) -> Touch:
        tool = self.station.tool
        assert tool is not None
        force = tool.axial_stiffness_N_per_m * max(float(felt.deflection_T[2]), 0.0)
        return Touch(
            id=name,
            feature=PLANE,
            X_BF=forward_kinematics(self.station.arm, felt.q),
            p_FT=np.asarray(tool.X_FT.multiply(felt.deflection_T)),
            radius=tool.tip_radius_m - tool.indentation(force),
            p_C=felt.place.p_C,
            direction_C=felt.place.n_C,
            sigma_scan=max(felt.place.sigma_m, 2.5e-5),
            q=felt.q,
        )


class TouchJob(Job[TouchPlanning]):
    """The job of a scenario with a `touch` part."""

    key = "touch"
    config = TouchConfig

    def check(self, scenario: Scenario) -> None:
        """See Job."""
        check_touch(scenario)

    def plan(self, scenario: Scenario, station: Station, seed: int) -> TouchPlanning:
        """See Job: what is planned from once the part is scanned."""
        config = scenario.part(TouchConfig)
        assert config is not None
        result = load_result(Path(config.result))
        if result.robot and result.robot != scenario.arm:
            raise InputError(f"touch.result is of the arm '{result.robot}', and the scenario has a {scenario.arm}.")
        correction = correction_from_document(result.scanner_correction) or ScannerCorrection()
        return TouchPlanning(
            seam_planning(scenario, station, servo_config(scenario, station)),
            RigidTransform(result.X_BC),
            correction,
            config,
        )

    def add(self, wiring: Wiring, spine: Spine, plan: TouchPlanning) -> AddedTouches:
        """See Job."""
        station, scenario, config = wiring.station, wiring.scenario, plan.config
        assert station.tool is not None
        assert isinstance(scenario.finger_camera, FingerCameraConfig)
        slower = 1.0 / scenario.job.speed_factor
        motion = TouchMotion(
            q_home=np.deg2rad(scenario.home_deg),
            descent_m_s=1e-3 * config.descent_mm_s,
            press_m=1e-3 * config.press_mm,
            deepest_m=1e-3 * (config.deepest_mm + config.press_mm),
            move_timeout_s=MOVE_TIMEOUT_S * slower,
            maximum_time_s=scenario.job.maximum_time_s * slower,
        )
        planner = wiring.add("touch_planner", TouchPlanner(plan, station.background))
        finger = wiring.add(
            "deformation_estimator",
            ArucoDeformationEstimator(station.arm, station.tool, scenario.finger_camera.camera(), station.background),
        )
        procedure = wiring.add("touch_procedure", TouchProcedure(station.arm, station.tool, motion))
        wiring.connect(planner, scan=wiring.out("scanner.scan"), job=procedure.GetOutputPort("job"))
        wiring.connect(finger, image=wiring.out("finger_camera.image"), history=spine.arm.history)
        planned, deformation = planner.GetOutputPort("planned_touches"), finger.GetOutputPort("deformation")
        spine.serve(procedure, planned_touches=planned, deformation=deformation)
        wiring.feed("scanner.trigger", procedure.GetOutputPort("trigger"))
        wiring.feed("finger_camera.streaming", procedure.GetOutputPort("streaming"))
        return AddedTouches(
            result=load_result(Path(config.result)),
            station=station,
            points=config.points,
            procedure=procedure,
            ports=procedure.ports(shown={"scan": wiring.out("scanner.scan")}),
            maximum_time_s=motion.maximum_time_s,
        )


JOB = TouchJob()
