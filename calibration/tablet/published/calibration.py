"""The tablet paper's two-stage calibration: chain, affine pair, and the hand position for a pixel."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from weldcal.calibration.tablet.published.chain import Model, place_landmarks, search_range
from weldcal.calibration.tablet.published.distances import DistanceMinimum, Residuals, minimise_distances
from weldcal.calibration.tablet.published.two_stage import (
    AFFINE_NONE,
    AFFINE_RANGE,
    CENTRE,
    Fitness,
    Sign,
    apply_affine,
    fitness,
    stage1_residuals,
    stage2_residuals,
)
from weldcal.calibration.tablet.touches import TabletTouches, check_touches
from weldcal.models.arrays import Array

Minimiser = Callable[[Residuals, Array], DistanceMinimum]
"""Finds a minimum of residuals within a range (p, 2)."""


@dataclass(frozen=True)
class StageResult:
    """One stage: its parameters (mm and degrees, named in chain.py and two_stage.py), its fitness, its cost."""

    parameters: Array
    fitness: Fitness
    evaluations: int


def from_the_middle(residuals: Residuals, search: Array) -> DistanceMinimum:
    """The fast solver from the middle of the range, where there is no better idea."""
    return minimise_distances(residuals, search.mean(axis=1), search)


def tablet_stage1(
    touches: TabletTouches,
    model: Model = "htm",
    sign: Sign = Sign.PRINTED,
    *,
    dh_offset_in_error: bool = True,
    minimiser: Minimiser = from_the_middle,
) -> StageResult:
    """Stage 1 (Eqs. 17-20): the twelve parameters of a chain.

    Raises what check_touches raises. (alpha_t, beta_t) and their negatives are the same minimum: a plane seen in x and y
    only.
    """
    check_touches(touches)
    found = minimiser(lambda x: stage1_residuals(touches, x, model, sign, dh_offset_in_error), search_range(model))
    return StageResult(found.parameters, fitness(found.residuals), found.evaluations)


def tablet_stage2(
    touches: TabletTouches,
    stage1: Array,
    model: Model = "htm",
    sign: Sign = Sign.PRINTED,
    *,
    dh_offset_in_error: bool = True,
    minimiser: Minimiser | None = None,
) -> StageResult:
    """Stage 2 (Eqs. 21-24): the ten parameters of the affine pair on top of ``stage1`` (12,)."""
    placed = place_landmarks(touches, stage1, model, dh_offset_in_error)

    def residuals(x: Array) -> Array:
        return stage2_residuals(touches, x, placed, sign)

    found = (
        minimise_distances(residuals, AFFINE_NONE, AFFINE_RANGE)
        if minimiser is None
        else minimiser(residuals, AFFINE_RANGE)
    )
    return StageResult(found.parameters, fitness(found.residuals), found.evaluations)


def hand_to_touch(
    fitted: TabletTouches,
    stage1: Array,
    affine: Array | None,
    uv_px: Array,
    depth_m: Array,
    theta_rad: Array,
    model: Model = "htm",
) -> Array:
    """Hand positions (m, 2) m from which the pen touches what is seen at ``uv_px`` (m, 2), by Eq. 8, or Eq. 25 with an
    affine pair (10,).

    ``fitted``: the touches that the parameters come from; A_n turns about their landmark 4.
    """
    m = len(uv_px)
    zeros = np.zeros((m, 2))
    query = replace(
        fitted, uv_px=uv_px, depth_m=depth_m, theta_rad=theta_rad, hand_m=zeros, delta_px=zeros, landmark_px=zeros
    )
    asked = place_landmarks(query, stage1, model)
    if affine is None:
        return np.asarray(1e-3 * (asked.seen - asked.pen)[0])
    own = place_landmarks(fitted, stage1, model)
    a = np.atleast_2d(affine)
    centre = min(CENTRE, len(fitted.uv_px) - 1)
    first = apply_affine(a[:, :5], own.seen, own.seen[:, centre])
    about = (first - own.pen)[:, centre]
    moved = apply_affine(a[:, :5], asked.seen, own.seen[:, centre]) - asked.pen
    return np.asarray(1e-3 * apply_affine(a[:, 5:], moved, about)[0])
