"""SeamPlanner: asks in the background for the plan of each seam and pass, from a scan of the workpiece."""

import dataclasses as dc
from typing import Self

from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.systems.background import Answer, Background, BackgroundSystem
from weldcal.systems.jobs.weld.seam_planning import SeamPlanning, Views, plan_drawn_seam, plan_pass, plan_seam
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import CalibrationStatus, JobCommand, PlannedSeam, Scan, ScanView
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.welding.seam.restart import Restart


class SeamPlanner(BackgroundSystem):
    """Plans the seam from the workpiece's scan, with its CAD or from the cloud only, and maps it to the base by X_BC.

    .. pydrake_system::

        name: SeamPlanner
        input_ports:
        - scan
        - job
        - calibration_status
        - servo_report
        - history
        output_ports:
        - planned_seam

    Without calibration in the job, `X_BC_known` is used, with the scan as it is. For a scanner on the flange
    `X_FC_known` is used, and `history` (else it may stay open) gives the flange's pose at the scan. Where the job takes
    several scans, one plan is made from all of them after the last. The plan is made beside the control loop.
    """

    def __init__(
        self,
        planning: SeamPlanning,
        X_BC_known: RigidTransform | None = None,
        background: Background | None = None,
        period_s: float = 0.02,
        X_FC_known: RigidTransform | None = None,
    ) -> None:
        super().__init__("planned_seam", PlannedSeam(), background, period_s)
        self._planning, self._X_BC_known, self._X_FC_known = planning, X_BC_known, X_FC_known
        self._scan = self.DeclareAbstractInputPort("scan", AbstractValue.Make(Scan()))
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._status = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))
        self._report = self.DeclareAbstractInputPort("servo_report", AbstractValue.Make(ServoReport()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))

    def restarted(self, restart: Restart) -> Self:
        """The same planner, which goes on with a broken weld."""
        self._planning = dc.replace(self._planning, restart=restart)
        return self

    def ask(self, context: Context, newest: PlannedSeam) -> Answer[PlannedSeam] | None:
        """Ask for the plan from a new scan of the workpiece."""
        scan: Scan = self._scan.Eval(context)
        job: JobCommand = self._job.Eval(context)
        if job.weld_pass > newest.weld_pass and newest.reason is None:
            planning = self._planning.of_seam(job.seam)
            report: ServoReport = self._report.Eval(context)
            return self.background.ask(plan_pass, planning, newest, job.weld_pass, report.state)
        follows = job.phase == "plan_seam"
        if follows and ((job.seam, job.piece) == newest.key[1:] or newest.reason is not None):
            return None
        old = scan.sequence <= newest.sequence or scan.sequence != job.scan_sequence or job.scan_purpose != "workpiece"
        if old and not follows:
            return None
        X_BC, correction, planning = self._X_BC_known, ScannerCorrection(), self._planning
        if self._X_FC_known is not None:
            X_BF = self._history.Eval(context).pose_at(planning.arm, scan.capture_time)
            X_BC = None if X_BF is None else X_BF @ self._X_FC_known
        elif X_BC is None:
            status: CalibrationStatus = self._status.Eval(context)
            X_BC, correction = status.X_BC, status.correction
            planning = dc.replace(
                planning,
                arm=status.arm_or(planning.arm),
                estimate=status.estimate,
                local_field=status.local_field,
                arm_errors=None if status.refinement is None else status.refinement.arm_errors,
            )
        planning = dc.replace(planning.of_seam(job.seam), piece=job.piece, earlier=newest.records)
        if follows:
            views = newest.views or (ScanView(scan, X_BC),)
            return self.plan(dc.replace(planning, q_from=newest.q_retract), views, correction)
        views = (*(newest.views if job.view else ()), ScanView(scan, X_BC))
        if job.view + 1 < job.views and X_BC is not None:
            return self.background.ask(_kept, PlannedSeam(sequence=scan.sequence, views=views, records=newest.records))
        return self.plan(planning, views, correction)

    def plan(self, planning: SeamPlanning, views: Views, correction: ScannerCorrection) -> Answer[PlannedSeam]:
        """Start the plan from these views."""
        return self.background.ask(plan_seam, planning, views[-1].scan, views[-1].X_BC, correction, views[:-1])


def _kept(plan: PlannedSeam) -> PlannedSeam:
    return plan


class DrawnSeamPlanner(SeamPlanner):
    """A SeamPlanner that uses the fixture's drawing, for parts whose shape the plate's registration does not support.

    .. pydrake_system::

        name: DrawnSeamPlanner
        input_ports:
        - scan
        - job
        - calibration_status
        - servo_report
        - history
        output_ports:
        - planned_seam
    """

    def plan(self, planning: SeamPlanning, views: Views, correction: ScannerCorrection) -> Answer[PlannedSeam]:
        """Start the plan; of the scan only its number is used."""
        return self.background.ask(plan_drawn_seam, planning, views[-1].scan.sequence)
