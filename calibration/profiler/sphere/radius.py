"""Compares the sphere's stated radius with the one that the profiles themselves show, and refuses a wrong one."""

from dataclasses import dataclass, replace

import numpy as np

from weldcal.calibration.errors import RadiusError
from weldcal.calibration.profiler.sphere.joint import SphereEstimate, last_step
from weldcal.calibration.profiler.sphere.model import ParameterLayout, SphereData, SphereProblem, SphereSigmas
from weldcal.calibration.profiler.sphere.start import sphere_starts

SCALE_SIGMAS = 3.0  # of the prior of the profiler's scale: what a sensor may be off, its radius may be
NOISE_SIGMAS = 4.0  # a choice: 6 in 100,000 normal draws lie beyond
KNOWN = 0.03  # one sigma of a radius, as a share of it, that is known at all
BETTER = 0.4  # what another radius must leave of chi-square, and below which it must then be
WORST_CHI2 = 100.0  # as sphere_joint has it: beyond it no sphere explains the profiles
NAMED = 0.05  # of a ratio of radii that is called the diameter
GOOD_CHI2 = 4.0  # of a fit whose sigmas are wrong by two at most
ROUNDS, SETTLED = 12, 1e-3
STARTS = (1.0, 0.5, 2.0)  # times the stated radius: as given, a diameter given, half of it given


@dataclass(frozen=True)
class FreeRadius:
    """The radius that profiles show, its sigma, both in m, and the reduced chi-square of the fit with it."""

    radius_m: float
    sigma_m: float
    reduced_chi2: float


def free_radius(data: SphereData, start_m: float, sigmas: SphereSigmas) -> FreeRadius | None:
    """The radius by the scans alone (rigid sensor, no touches), from a start; None where it does not settle.

    Gauss-Newton in the radius, all other unknowns solved at each step.
    """
    scans, radius = SphereData(poses=data.poses, profiles=data.profiles, radius_m=start_m), start_m
    layout = ParameterLayout(tip=False, affine=False, joints=False)
    problem = SphereProblem(scans, layout, sigmas)
    starts = sphere_starts(data.poses, problem.profiles, start_m)
    if not starts:
        return None
    R, x = starts[0][0], np.concatenate([np.zeros(3), starts[0][1], starts[0][2]])
    for _ in range(ROUNDS):
        problem = SphereProblem(replace(scans, radius_m=radius), layout, sigmas)
        _, found = problem.solved(R, np.zeros(3), x)
        x = np.asarray(found.x)
        r = problem.residual(x)
        step, sigma = last_step(np.column_stack([problem.derivatives(x), problem.by_radius()]), r)
        if abs(step) < SETTLED * radius:
            chi2 = float(r @ r) / max(len(r) - len(x) - 1, 1)
            return FreeRadius(radius + step, sigma * float(np.sqrt(max(1.0, chi2))), chi2)
        radius = float(np.clip(radius + step, 0.6 * radius, 1.6 * radius))
    return None


def check_radius(data: SphereData, sigmas: SphereSigmas, stated: SphereEstimate | None) -> None:
    """Refuse a stated radius that the profiles contradict; `stated`: the rigid fit with it, None where there is none.

    A profiler's scale error shows as another radius: up to three sigmas of its prior is its error, more is another
    sphere.

    Raises:
        RadiusError: the profiles determine the radius, and it is another one.
    """
    R = data.radius_m
    allowed = SCALE_SIGMAS * sigmas.affine * R
    # what a poor fit says of the radius, to first order, says nothing
    near = stated is not None and abs(stated.radius_change_m) <= allowed + NOISE_SIGMAS * stated.radius_sigma_m
    if stated is not None and near and stated.reduced_chi2 < GOOD_CHI2:
        return
    tried = [one for k in STARTS if (one := free_radius(data, k * R, sigmas)) is not None]
    known = [one for one in tried if one.sigma_m < KNOWN * one.radius_m and one.reduced_chi2 < WORST_CHI2]
    best = min(known, key=lambda one: one.reduced_chi2, default=None)
    if best is None:
        if stated is None or near:
            return  # whatever the fit itself refuses for
        raise RadiusError(
            f"The profiles contradict a sphere of {1e3 * R:.2f} mm radius and show no other one. Check the radius, the"
            " poses and that only the sphere is in the profiles."
        )
    worse = np.inf if stated is None else stated.reduced_chi2
    if abs(best.radius_m - R) <= allowed + NOISE_SIGMAS * best.sigma_m or best.reduced_chi2 > BETTER * worse:
        return
    said = f"The profiles show a sphere of {1e3 * best.radius_m:.2f} mm radius, and {1e3 * R:.2f} mm is stated"
    if abs(2.0 * best.radius_m / R - 1.0) < NAMED:
        raise RadiusError(f"{said}: that is its diameter. Give the radius, {1e3 * R / 2:.5g} mm.")
    if abs(best.radius_m / (2.0 * R) - 1.0) < NAMED:
        raise RadiusError(f"{said}: that is half of it. Give the radius, {2e3 * R:.5g} mm.")
    raise RadiusError(f"{said}. Check the radius and the unit.")
