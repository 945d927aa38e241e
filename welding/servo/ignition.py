"""Where the arc starts, and the wait for it: the tool stands, pressed on, until the power source has established it."""

from weldcal.welding.numerics import Array, changed, clip
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import ServoSample, WeldingState


def start_arc(state: WeldingState, curve: SeamCurve) -> float:
    """Arc length m on the moved plan at which the arc starts: the measured start of the groove, else the planned one."""
    return 0.0 if state.start_point is None else curve.nearest(state.start_point, 0.0, 0.02)


def with_arc(state: WeldingState, sample: ServoSample) -> WeldingState:
    """The state of a tick whose arc is established, or not asked for."""
    if not state.torch_on or (state.arc_seen and state.arc_waited_s == 0.0):
        return state
    # the ramp to rest has ended all speeds: they start again from zero
    lit_at = state.lit_at if state.arc_seen else sample.time
    return changed(state, arc_seen=True, arc_waited_s=0.0, lit_at=lit_at)


def wait_for_arc(
    state: WeldingState, sample: ServoSample, config: ServoConfig, dt: float
) -> tuple[WeldingState, Array, str | None]:
    """One tick with the torch on and no arc: the next state, the motion (6,) that ramps to rest, and the reason to stop.

    No time of standing counts as a lack of progress.
    """
    V_stop = state.V if state.arc_waited_s == 0.0 else state.V_stop
    waited = state.arc_waited_s + dt
    share = clip(1.0 - waited / config.limits.ramp_s, 0.0, 1.0)
    state = changed(
        state,
        arc_waited_s=waited,
        V_stop=V_stop,
        v_tip=0.0,
        omega=0.0,
        u_n=0.0,
        u_a=0.0,
        advanced=(state.advanced[0], sample.time),
    )
    torch = config.torch
    if not state.arc_seen and waited > torch.ignition_limit_s:
        return (
            state,
            share * V_stop,
            f"The arc was not established within {torch.ignition_limit_s:g} s; check the power source, wire and gas.",
        )
    if state.arc_seen and waited > torch.arc_lost_s:
        return (
            state,
            share * V_stop,
            f"The arc went out for {torch.arc_lost_s:g} s; check the power source, wire and gas.",
        )
    return state, share * V_stop, None
