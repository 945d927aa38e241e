"""Holds a weld and lets it go on: arc off and tool at rest.

Then back along its own path a little, and on with the arc.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.welding.numerics import Array, changed, finite, norm
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.seam.refinement import drop_pending
from weldcal.welding.servo.contact import is_new_frame, with_frame
from weldcal.welding.servo.faults import fault, watch
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import Diagnostics, Phase, ServoSample, WeldingCommand, WeldingState
from weldcal.welding.servo.step import welding_step

RAMP_S = 0.04  # from welding speed to rest
STILL_S = 0.25  # of rest before the tool counts as standing: the arm lags behind its commands
OVERLAP_M = 5.0e-3  # of seam welded twice, over the crater that the arc left
TRAIL_TICKS = 600  # 5 s: longer than the overlap takes at any speed but creeping round a corner
EASE_S = 0.15  # from rest to the speed of the way back, and to rest again
FEEDBACK_PER_S = 8.0  # as the FlangeMover
BACK_AGAIN_M, BACK_AGAIN_RAD = 0.1e-3, 2e-3
LONGEST_BACK_S = 8.0  # longer than the trail of 5 s that the way back follows: what takes longer is blocked
MOVED_M = 1.0e-3  # a tool at rest that is found so far away has been moved


class TrailPoint(NamedTuple):
    """One tick with the arc on: pose and commanded twist (6,) of T, and where tip and torch were on the seam."""

    X_BT: RigidTransform
    V: Array
    s_tip: float
    s_torch: float
    torch_arc: float
    progress: float
    residual: Array


@dataclass(frozen=True, kw_only=True)
class Interruption:
    """An operator's hold of a weld; `Interruption()` is a weld that is not held.

    Attributes:
        trail: the newest ticks with the arc on, oldest first.
        step: "" (not held), "stop" (to rest, and at rest) or "back".
        ticks: since the step began.
        V_stop: (6,) the twist at its begin; p_stop: (3,) m, the tool at rest, None before.
        at, goal: places on the trail, in ticks: of the tool on its way back, and where that ends; nan without a way
            back.
    """

    trail: tuple[TrailPoint, ...] = ()
    step: str = ""
    ticks: int = 0
    V_stop: Array = field(default_factory=lambda: np.zeros(6))
    p_stop: Array | None = None
    at: float = math.nan
    goal: int = 0

    def at_rest(self, config: ServoConfig) -> bool:
        """Whether a held tool has come to rest."""
        return self.step == "stop" and self.ticks * config.period_s > RAMP_S + STILL_S

    @property
    def way_back(self) -> tuple[TrailPoint, ...]:
        """What lies between the tool and the place where the weld goes on, that place first.

        Empty without a way back.
        """
        return () if not self.step or math.isnan(self.at) else self.trail[self.goal : round(self.at) + 1]

    @property
    def way_back_m(self) -> float:
        """Length of the way back along the seam, m."""
        way = self.way_back
        return max(way[-1].s_torch - way[0].s_torch, 0.0) if way else 0.0


def interruptible_step(
    state: WeldingState, held: Interruption, sample: ServoSample, plan: SeamCurve, config: ServoConfig, holds: bool
) -> tuple[WeldingState, Interruption, WeldingCommand]:
    """One tick of `welding_step`, or of a hold while `holds`, and of the way back after it.

    A hold turns the arc off in its first tick and the tool comes to rest within RAMP_S, pressed on as it is. When it is
    let go, the tool goes back along the poses that it came by, as far as OVERLAP_M of seam before the place where the
    arc went out, but not before its start; there the arc starts again as at the seam's begin, over what is welded
    already. Without an arc there is no way back. Faults are watched for throughout. Without a hold every number is that
    of `welding_step`.
    """
    over = state.phase in (Phase.DONE, Phase.FAULT)
    sane = state.plan_fit is not None and math.isfinite(sample.time) and finite(sample.X_BT.translation())
    if over or not sane or not (holds or held.step):
        state, command = welding_step(state, sample, plan, config)
        return state, Interruption(trail=_longer(held.trail, state, sample)), command
    was_lit = state.torch_on
    state = changed(state, torch_on=False)
    if is_new_frame(state, sample):
        assert state.plan_fit is not None
        state = with_frame(state, sample, state.plan_fit.curve.frame(state.s_tip), config)
    state = watch(changed(state, time=sample.time), sample, config)
    p_BT, p_stop = np.asarray(sample.X_BT.translation()), held.p_stop
    held = _next_step(state, held, sample, config, holds, was_lit)
    if p_stop is not None and norm(p_BT - p_stop) > MOVED_M:
        state = fault(state, "The tool was moved while the weld was held; start the weld anew.")
    if held.step == "back" and held.ticks * config.period_s > LONGEST_BACK_S:
        state = fault(state, "The tool did not come back along its path after a hold; check what is in its way.")
    if state.phase == Phase.FAULT:
        state, command = welding_step(state, sample, plan, config)
        return state, Interruption(), command
    if not held.step:
        state, command = welding_step(_resumed(state, held, sample), sample, plan, config)
        return state, Interruption(trail=held.trail[: held.goal + 1] if held.trail else ()), command
    if held.step == "back":
        held, V = _back(held, sample, config)
        phase = Phase.BACK
    else:
        share = max(0.0, 1.0 - held.ticks * config.period_s / RAMP_S)
        V, phase = share * held.V_stop, Phase.HELD
    held = changed(held, ticks=held.ticks + 1)
    state = changed(state, V=V)
    values = Diagnostics(
        delta_n=state.delta_n,
        delta_axial=state.delta_axial,
        s_tip=state.s_tip,
        s_torch=state.s_torch if math.isnan(held.at) else held.trail[round(held.at)].s_torch,
        gain=state.gain,
        n_points=len(state.refined),
    )
    return state, held, WeldingCommand(V, False, phase, None, values)


def _longer(trail: tuple[TrailPoint, ...], state: WeldingState, sample: ServoSample) -> tuple[TrailPoint, ...]:
    """The trail with this tick, while the arc is on."""
    if not state.torch_on:
        return ()
    here = TrailPoint(
        X_BT=sample.X_BT,
        V=state.V,
        s_tip=state.s_tip,
        s_torch=state.s_torch,
        torch_arc=state.torch_arc,
        progress=state.progress,
        residual=state.residual,
    )
    return (*trail[1 - TRAIL_TICKS :], here)


def _next_step(
    state: WeldingState, held: Interruption, sample: ServoSample, config: ServoConfig, holds: bool, was_lit: bool
) -> Interruption:
    """The hold with its step of this tick; step "" where the weld goes on."""
    if not held.step:
        trail = held.trail if was_lit else ()
        out_at = trail[-1].s_torch if trail else 0.0
        goal = max((k for k, t in enumerate(trail) if t.s_torch <= out_at - OVERLAP_M), default=0)
        at = float(len(trail) - 1) if trail else math.nan
        return Interruption(trail=trail, step="stop", ticks=0, V_stop=state.V, p_stop=None, at=at, goal=goal)
    if held.step == "stop":
        if not held.at_rest(config):
            return held
        p_stop = np.asarray(sample.X_BT.translation()) if held.p_stop is None else held.p_stop
        if holds:
            return changed(held, p_stop=p_stop)
        return changed(held, step="" if math.isnan(held.at) else "back", ticks=0, p_stop=None)
    if holds:
        return changed(held, step="stop", ticks=0, V_stop=state.V, p_stop=None)
    goal = held.trail[held.goal].X_BT
    there = norm(np.asarray(goal.translation() - sample.X_BT.translation())) < BACK_AGAIN_M
    there = there and norm(_turn(sample.X_BT, goal)) < BACK_AGAIN_RAD
    return changed(held, step="") if held.at <= held.goal and there else held


def _back(held: Interruption, sample: ServoSample, config: ServoConfig) -> tuple[Interruption, Array]:
    """The next place on the way back, and the twist (6,) that leads there."""
    ease = EASE_S / config.period_s
    left = held.at - held.goal
    rate = min(1.0, (held.ticks + 1.0) / ease, math.sqrt(2.0 * max(left, 0.0) / ease))
    at = max(held.at - rate, float(held.goal))
    point = held.trail[round(at)]
    aside = np.asarray(point.X_BT.translation() - sample.X_BT.translation())
    V = FEEDBACK_PER_S * np.concatenate([_turn(sample.X_BT, point.X_BT), aside]) - (held.at - at) * point.V
    return changed(held, at=at), V


def _turn(X_from: RigidTransform, X_to: RigidTransform) -> Array:
    """Rotation vector (3,) rad from one pose to another, in B."""
    turn = RotationMatrix(X_to.rotation() @ X_from.rotation().inverse()).ToAngleAxis()
    return np.asarray(turn.angle() * turn.axis())


def _resumed(state: WeldingState, held: Interruption, sample: ServoSample) -> WeldingState:
    """The state in which the weld goes on: all speeds zero, the arc not seen yet, tip and torch where the tool is."""
    if held.trail:
        on = held.trail[held.goal]
        state = changed(
            state,
            s_tip=on.s_tip,
            s_torch=on.s_torch,
            torch_arc=on.torch_arc,
            progress=on.progress,
            residual=on.residual,
            arc_seen=False,
        )
    return changed(
        state,
        V=np.zeros(6),
        v_tip=0.0,
        omega=0.0,
        u_n=0.0,
        u_a=0.0,
        arc_waited_s=0.0,
        stand="",
        progress_log=(),
        # friction has turned: the tip counts as in contact, and as proven only when it leans on its wall again
        proven=False,
        steer=0.0,
        felt=0.0,
        refined=drop_pending(state.refined),
        advanced=(sample.time, state.s_torch),
    )
