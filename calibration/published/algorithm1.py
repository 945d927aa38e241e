"""Algorithm 1 of the flange paper: a pool of four pairs, improved scan by scan by its verification figure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import fit_rigid
from weldcal.calibration.published.icp import FAILED, VerificationError, Verifier
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

Cost = Callable[[Array], float]

POOL_SIZE = 4


def translation_cost(error: Array) -> float:
    """Norm of the translation of the error (6,), m: the paper's default."""
    return float(np.linalg.norm(error[3:]))


def work_radius_cost(work_radius_m: float) -> Cost:
    """Section 4.2: norm of (dx, dy, dz, r droll, r dpitch, r dyaw), r the work radius, m."""
    return axes_cost((0, 1, 2, 3, 4, 5), work_radius_m)


def translation_and_rotation_cost(work_radius_m: float) -> Cost:
    """Translation norm plus the rotation's displacement at ``work_radius_m`` from the flange centre, m: a bound on the
    error there, where the paper's work_radius_cost is a norm of all six."""

    def cost(error: Array) -> float:
        return float(np.linalg.norm(error[3:]) + work_radius_m * np.linalg.norm(error[:3]))

    return cost


def axes_cost(axes: tuple[int, ...], work_radius_m: float) -> Cost:
    """Norm over chosen components of the error (0-2 rotation times ``work_radius_m``, 3-5 translation), m.

    Section 4.2's choice of axes: (3, 4) is its pick-and-place example, with an end-effector that gives way along z.
    """
    if not axes or any(not 0 <= a < 6 for a in axes):
        raise InputError("The axes of a cost are numbers from 0 to 5: 0-2 rotation, 3-5 translation.")

    def cost(error: Array) -> float:
        scaled = error * np.array([work_radius_m] * 3 + [1.0] * 3)
        return float(np.linalg.norm(scaled[list(axes)]))

    return cost


COST_AXES = ("roll", "pitch", "yaw", "x", "y", "z")
COSTS = ("translation", "translation_and_rotation", "work_radius")


def named_cost(name: str, work_radius_m: float = 0.2, axes: Sequence[str] = COST_AXES) -> Cost:
    """The cost a scenario asks for: the translation; section 4.2's norm over the chosen ``axes`` of COST_AXES at the
    work radius (``work_radius``); or a bound on the error at that radius (``translation_and_rotation``). Raises
    InputError."""
    if name not in COSTS:
        raise InputError(f"calibration.cost must be {', '.join(COSTS[:-1])} or {COSTS[-1]}, not '{name}'.")
    if not work_radius_m >= 0.0:
        raise InputError(f"calibration.work_radius_mm must not be negative, and it is {1e3 * work_radius_m:g}.")
    unknown = [axis for axis in axes if axis not in COST_AXES]
    if unknown or not axes:
        raise InputError(
            f"calibration.cost_axes must be some of {', '.join(COST_AXES)}, not {', '.join(unknown) or 'none'}."
        )
    if name == "work_radius":
        return axes_cost(tuple(COST_AXES.index(axis) for axis in axes), work_radius_m)
    return translation_cost if name == "translation" else translation_and_rotation_cost(work_radius_m)


@dataclass(frozen=True, kw_only=True)
class Algorithm1State:
    """State of Algorithm 1 after k new scans; immutable, each step returns the next one.

    ``pool``: up to four pairs; ``X_BC`` and ``error`` are H_optimal and e_optimal, ``cost`` its cost (m), infinite
    until a registration succeeds; ``history`` has one (scans used, cost) entry per scan from the fourth on.
    """

    e_required: float
    k_max: int
    pool: tuple[Observation, ...] = ()
    X_BC: RigidTransform | None = None
    error: VerificationError = FAILED
    cost: float = float("inf")
    k: int = 0
    history: tuple[tuple[int, float], ...] = field(default=())

    @property
    def done(self) -> bool:
        """True when the cost has come down to the required one or the scans are used up (line 4)."""
        return len(self.pool) == POOL_SIZE and (self.cost <= self.e_required or self.k >= self.k_max)

    @property
    def X_BC_compensated(self) -> RigidTransform | None:
        """Eq. (21): H_optimal e_optimal, which makes the figure itself zero and says nothing about any other pose."""
        return None if self.X_BC is None or self.error.X_CpC is None else self.X_BC @ self.error.X_CpC


def algorithm1_start(e_required: float = 2e-4, k_max: int = 100) -> Algorithm1State:
    """An empty pool. ``e_required`` in m. Raises InputError unless both are positive."""
    if not e_required > 0.0 or k_max < 1:
        raise InputError("Algorithm 1 needs a required error above zero (metres) and at least one iteration.")
    return Algorithm1State(e_required=e_required, k_max=k_max)


def algorithm1_step(
    state: Algorithm1State,
    observation: Observation,
    verification: Verifier,
    cost: Cost = translation_cost,
    *,
    as_printed: bool = False,
) -> Algorithm1State:
    """One new pair (paper, Algorithm 1, lines 5 to 15); the first four fill the pool (lines 2 and 3).

    Each of the four is replaced in turn by the new pair; a replacement stays only if the cost falls. The new pair
    enters at most once, as in the authors' program: with it twice, three distinct points would be left. ``as_printed``
    follows lines 6 to 15 to the letter, where a replacement that stays is there when the next one is tried, so that the
    pool may come to hold the same pair two or three times. A finished state is returned unchanged.
    """
    if state.done:
        return state
    if len(state.pool) < POOL_SIZE:
        pool = (*state.pool, observation)
        if len(pool) < POOL_SIZE:
            return replace(state, pool=pool)
        X, error, value = _score(pool, verification, cost)
        return replace(state, pool=pool, X_BC=X, error=error, cost=value, history=((POOL_SIZE, value),))
    best = (state.pool, state.X_BC, state.error, state.cost)
    for i in range(POOL_SIZE):
        old = best[0] if as_printed else state.pool
        pool = (*old[:i], observation, *old[i + 1 :])
        X, error, value = _score(pool, verification, cost)
        if value < best[3]:
            best = (pool, X, error, value)
    k = state.k + 1
    return replace(
        state,
        pool=best[0],
        X_BC=best[1],
        error=best[2],
        cost=best[3],
        k=k,
        history=(*state.history, (POOL_SIZE + k, best[3])),
    )


def _score(
    pool: tuple[Observation, ...], verification: Verifier, cost: Cost
) -> tuple[RigidTransform | None, VerificationError, float]:
    try:
        X = fit_rigid(np.array([o.p_BR for o in pool]), np.array([o.p_CR for o in pool]))
    except ValueError:
        return None, FAILED, float("inf")
    error = verification(X)
    return X, error, cost(error.value) if error.found else float("inf")
