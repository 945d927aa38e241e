"""Compute the tip's spatial velocity and the torch request from planned seam and tip deformation."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arms.compiled_kinematics import tick_flange_pose
from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.tool import WeldingTool
from weldcal.systems.jobs.weld.arm_way import leaning
from weldcal.systems.jobs.weld.aruco_deformation_estimator import Deformation
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, JobCommand, Message, PlannedSeam, believed_arm
from weldcal.welding.numerics import changed
from weldcal.welding.passes.felt import WeldPass, pass_config
from weldcal.welding.record.schedule import GapAlong, WeldSchedule
from weldcal.welding.servo.felt_before import start_state
from weldcal.welding.servo.interruption import Interruption, interruptible_step
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Phase, ServoSample, WeldingCommand, WeldingState

TELEMETRY = (
    "phase", "torch_on", "s_tip", "s_torch", "e_t", "e_height", "n_d_dot_n_t", "conditioning", "omega",
    "delta_n", "delta_axial", "torch_speed", "tip_speed", "gain", "n_points", "tick_time",
    "p_BT_x", "p_BT_y", "p_BT_z", "q_BT_w", "q_BT_x", "q_BT_y", "q_BT_z",
    "tip_x", "tip_y", "tip_z", "target_x", "target_y", "target_z",
)  # fmt: skip
_FIGURES = TELEMETRY[2 : TELEMETRY.index("tick_time")]
_NOWHERE = np.full(3, np.nan)
PHASE_CODES = {phase: float(k) for k, phase in enumerate(Phase)}


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ServoReport(Message):
    """The servo's state for the sequencer, the viewer and the log; phase is IDLE outside a weld."""

    phase: str = "IDLE"
    torch_on: bool = False
    reason: str | None = None
    command: WeldingCommand | None = None
    state: WeldingState | None = None
    time: float = np.nan  # of the robot's sample, on the Diagram's clock, s
    X_BT: RigidTransform | None = None  # measured at that tick
    plan: int = 0  # sequence of the plan that is followed
    plan_key: tuple[int, int, int] = (0, 0, 0)  # of the same: several are made from one scan
    weld_pass: int = 0
    interruption: Interruption = dc.field(default_factory=Interruption)  # an operator's hold

    @property
    def way_back_m(self) -> float:
        """After a hold: along the seam, to where the weld goes on, m; else 0."""
        return self.interruption.way_back_m


def at_gap(config: ServoConfig, schedule: WeldSchedule, gap: GapAlong | None, state: WeldingState) -> ServoConfig:
    """The settings with the schedule's speed for the gap beside the torch; before the touch with its largest speed."""
    speeds = schedule.speeds_m_s()
    if gap is None or not speeds:
        return config
    speed = max(speeds) if state.plan_fit is None else schedule.speed_m_s(gap.at(state.s_torch), config.weld_speed_m_s)
    return changed(config, weld_speed_m_s=speed)


class WeldingVelocityServo(LeafSystem):
    """Algorithm 2 with the corrected equations, at 125 Hz, while the job's mode is `weld`.

    .. pydrake_system::

        name: WeldingVelocityServo
        input_ports:
        - planned_seam
        - deformation
        - position_measured
        - sample_time
        - job
        - arc_established
        - hold
        - calibration_status
        output_ports:
        - V_BT
        - servo_report
        - telemetry
        - torch_on

    `V_BT` (6) [omega rad/s; v m/s] of the tip frame in B, zero unless the job's mode is `weld`; `telemetry` as named in
    TELEMETRY (SI), all of one tick; `torch_on` (1) is the request for the process: job and servo must both enable it,
    and it passes the ProcessSwitch. While it is on and `arc_established` (1; unconnected: always) is 0 the tool stands.
    While `hold` (1; unconnected: never) is 1 the torch is off and the tool stands; it goes on from a little before that
    place. Where `calibration_status` (may stay open) has an arm with refined kinematics, that one is used.
    """

    def __init__(
        self,
        arm: ArmModel,
        tool: WeldingTool,
        config: ServoConfig,
        others: Sequence[ServoConfig] = (),
        passes: Sequence[WeldPass] = (),
        schedule: WeldSchedule | None = None,
    ) -> None:
        super().__init__()
        self._arm, self._tool, self._schedule = arm, tool, schedule
        radius_m = tool.tip_radius_m
        self._configs = [(c, *(pass_config(c, order, radius_m) for order in passes)) for c in (config, *others)]
        self._seam = self.DeclareAbstractInputPort("planned_seam", AbstractValue.Make(PlannedSeam()))
        self._deformation = self.DeclareAbstractInputPort("deformation", AbstractValue.Make(Deformation()))
        self._q = self.DeclareVectorInputPort("position_measured", 6)
        self._time = self.DeclareVectorInputPort("sample_time", 1)
        self._job = self.DeclareAbstractInputPort("job", AbstractValue.Make(JobCommand()))
        self._arc = self.DeclareVectorInputPort("arc_established", 1)
        self._hold = self.DeclareVectorInputPort("hold", 1)
        self._calibration = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(ServoReport()))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareVectorOutputPort("V_BT", 6, self._velocity, ticket | {self._job.ticket()})
        self.DeclareStateOutputPort("servo_report", self._state)
        self.DeclareVectorOutputPort("telemetry", len(TELEMETRY), self._telemetry, ticket)
        self.DeclareVectorOutputPort("torch_on", 1, self._torch, ticket | {self._job.ticket()})
        self.DeclarePeriodicUnrestrictedUpdateEvent(config.period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        job: JobCommand = self._job.Eval(context)
        old: ServoReport = context.get_abstract_state(self._state).get_value()
        planned: PlannedSeam = self._seam.Eval(context)
        if job.mode != "weld" or planned.seam is None:
            newer = (planned.key, planned.weld_pass) != (old.plan_key, old.weld_pass)
            if old.phase == Phase.DONE and newer and planned.seam is not None:
                # The next seam or pass is planned: what is reported of the last one would end it at once.
                state.get_mutable_abstract_state(self._state).set_value(ServoReport())
            elif old.phase not in ("IDLE", Phase.DONE, Phase.FAULT):
                report = dc.replace(old, phase="IDLE", torch_on=False, command=None, interruption=Interruption())
                state.get_mutable_abstract_state(self._state).set_value(report)
            return
        arm = believed_arm(self._calibration, context, self._arm)
        X_BT = tick_flange_pose(arm, self._q.Eval(context)) @ self._tool.X_FT
        arc = not self._arc.HasValue(context) or bool(self._arc.Eval(context)[0] > 0.5)
        sample = ServoSample(float(self._time.Eval(context)[0]), X_BT, self._deformation.Eval(context).sample, arc)
        memory = old.state if old.state is not None else start_state(planned.felt_before)
        config = self._configs[min(job.seam, len(self._configs) - 1)][planned.weld_pass]
        config = leaning(config, planned.lean_rad, planned.touch_arc_m, planned.sigma_m, planned.begins_m)
        if planned.felt_before is not None:  # the arc begins where it is ordered, however late the power source is
            config = dc.replace(config, torch=dc.replace(config.torch, from_rest=True))
        if planned.along is not None:
            config = planned.along.at(config, memory.s_tip, memory.s_torch)
        if self._schedule is not None:
            config = at_gap(config, self._schedule, planned.gap, memory)
        holds = self._hold.HasValue(context) and bool(self._hold.Eval(context)[0] > 0.5)
        memory, held, command = interruptible_step(memory, old.interruption, sample, planned.seam, config, holds)
        report = ServoReport(
            phase=str(command.phase),
            torch_on=command.torch_on,
            reason=command.reason,
            command=command,
            state=memory,
            time=sample.time,
            X_BT=sample.X_BT,
            plan=planned.sequence,
            plan_key=planned.key,
            weld_pass=planned.weld_pass,
            interruption=held,
        )
        state.get_mutable_abstract_state(self._state).set_value(report)

    def _velocity(self, context: Context, output: BasicVector) -> None:
        # The last report stays after a fault; its motion must not, when the job leaves the weld before the ramp has
        # ended.
        job: JobCommand = self._job.Eval(context)
        command = context.get_abstract_state(self._state).get_value().command
        output.SetFromVector(np.zeros(6) if command is None or job.mode != "weld" else command.V_BT)

    def _telemetry(self, context: Context, output: BasicVector) -> None:
        report: ServoReport = context.get_abstract_state(self._state).get_value()
        values = np.full(len(TELEMETRY), np.nan)
        values[:2] = (-1.0, 0.0)
        if report.command is not None and report.X_BT is not None:
            d = report.command.diagnostics
            values[:2] = (PHASE_CODES[report.command.phase], float(report.torch_on))
            n = 2 + len(_FIGURES)
            values[2:n] = [float(getattr(d, name)) for name in _FIGURES]
            values[n] = report.time
            values[n + 1 : n + 4] = report.X_BT.translation()
            values[n + 4 : n + 8] = report.X_BT.rotation().ToQuaternion().wxyz()
            values[n + 8 : n + 11] = _NOWHERE if d.p_BTip is None else d.p_BTip
            values[n + 11 :] = _NOWHERE if d.p_BTorch_target is None else d.p_BTorch_target
        output.SetFromVector(values)

    def _torch(self, context: Context, output: BasicVector) -> None:
        job: JobCommand = self._job.Eval(context)
        report: ServoReport = context.get_abstract_state(self._state).get_value()
        output.SetAtIndex(0, float(report.torch_on and job.process_on and not job.held))
