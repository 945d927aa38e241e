"""Start the arc with the torch at rest on the seam's start, and fill the crater at its end."""

from enum import StrEnum

from weldcal.welding.numerics import Array, changed, clip
from weldcal.welding.servo.settings import ServoConfig
from weldcal.welding.servo.state import ServoSample, WeldingState

SETTLES_S = 0.1  # a choice: four times the lag of the arm behind its commands (ServoConfig.lag_s)


class Stand(StrEnum):
    """Why the tool waits on the seam: for the arc, until the seam is hot, or in the crater."""

    NONE = ""
    START = "start"
    HOT = "hot"
    CRATER = "crater"


def way_to_rest_m(speed_m_s: float, config: ServoConfig) -> float:
    """How far the torch goes on from a speed in the ramp to rest, with the lag of the arm, m."""
    return speed_m_s * (0.5 * config.limits.ramp_s + config.lag_s)


def stand(state: WeldingState, why: Stand) -> WeldingState:
    """Return the state in which the motion begins to ramp to rest."""
    return changed(state, stand=why, stood_s=0.0, V_stop=state.V, v_tip=0.0, omega=0.0, u_n=0.0, u_a=0.0)


def stand_step(
    state: WeldingState, sample: ServoSample, config: ServoConfig, dt: float
) -> tuple[WeldingState, Array, bool]:
    """One tick of standing: the next state, the motion (6,) that ramps to rest, and whether the seam's end is over.

    At the start the torch is asked for at rest. The welding goes on `start_s` after the arc is there.
    """
    torch, stood = config.torch, state.stood_s + dt
    V = clip(1.0 - stood / config.limits.ramp_s, 0.0, 1.0) * state.V_stop
    at_rest_s = stood - config.limits.ramp_s - SETTLES_S
    # no time of standing counts as a lack of progress
    state = changed(state, stood_s=stood, advanced=(state.advanced[0], sample.time))
    if state.stand == Stand.START and at_rest_s >= 0.0:
        state = changed(stand(state, Stand.HOT), torch_on=True, lit_at=sample.time, arc_seen=False, arc_waited_s=0.0)
    elif state.stand == Stand.HOT and stood > torch.start_s:
        state = changed(state, stand=Stand.NONE, lit_at=sample.time)  # a weave begins here
    return state, V, state.stand == Stand.CRATER and at_rest_s >= torch.crater_s
