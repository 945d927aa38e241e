"""Difference between the flange's centres from two parts of one cloud, and its Cramer-Rao bound."""

import numpy as np
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.special import ndtr
from scipy.stats import norm

from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.flange.fit import FlangeFit, fit_flange
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard
from weldcal.systems.runner import Progress, no_progress

PARTS = (2, 4, 8)
_REACH_M = 0.0015  # about an edge, in which its blur shows
_INFORMATION = float(quad(lambda z: norm.pdf(z) ** 2 / ndtr(z), -8.0, 12.0)[0])  # of a soft edge of a Poisson process


def edge_blur(points_C: Array, fit: FlangeFit, *, outer: bool) -> tuple[float, float]:
    """Width (m, one sigma) over which the face's points thin out at an edge, and their density (1/m^2) on the face.

    Maximum likelihood of a Poisson process whose density falls as Phi across a circle. Raises ValueError where the edge
    was not seen.
    """
    radius = fit.outer_radius_m if outer else fit.bore_radius_m
    if radius is None:
        raise ValueError("the edge was not seen")
    d = points_C - fit.center_C
    h = d @ fit.normal_C
    rho = np.sqrt(np.maximum((d * d).sum(axis=1) - h * h, 0.0))[np.abs(h) < max(3.0 * fit.plane_rms_m, 0.0002)]
    edges = np.linspace(-_REACH_M, _REACH_M, 61)
    inward = radius - rho if outer else rho - radius
    count = np.histogram(inward, edges)[0]
    middle = 0.5 * (edges[1:] + edges[:-1])
    area = 2.0 * np.pi * (radius - middle if outer else radius + middle) * (edges[1] - edges[0])
    inside = middle > 0.5 * _REACH_M
    density = float(count[inside].sum() / area[inside].sum())

    def cost(p: Array) -> float:
        expected = density * area * ndtr((middle - p[0]) / np.exp(p[1])) + 1e-3
        return float((expected - count * np.log(expected)).sum())

    found = minimize(cost, [0.0, np.log(1e-4)], method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-3})
    return float(np.exp(found.x[1])), density


def center_bound(points_C: Array, fit: FlangeFit, parts: int) -> float:
    """Least rms distance (m) between the centres from two of ``parts`` random parts of a cloud, in the face's plane.

    Information of one edge about a coordinate of its centre: density x circumference x 0.90 / blur / 2, Poisson points,
    radius free (a full circle's centre does not depend on it); both edges add.
    """
    information = 0.0
    for outer, radius in ((True, fit.outer_radius_m), (False, fit.bore_radius_m)):
        if radius is not None:
            blur, density = edge_blur(points_C, fit, outer=outer)
            information += 0.5 * (density / parts) * 2.0 * np.pi * radius * _INFORMATION / blur
    return float(np.sqrt(2.0 * 2.0 / information))


def study_parts(
    clouds: list[Array], standard: FlangeStandard, *, draws: int = 4, seed: int = 0, progress: Progress = no_progress
) -> list[dict[str, float]]:
    """Divide each cloud (N, 3) m into 2, 4 and 8 random parts and compare the first two. Deterministic for ``seed``.

    Returns a row for each: parts, points in each, rms distance (mm) of two parts' centres, the least that any unbiased
    estimate could reach (mm), and what the stated covariances expect (mm).
    """
    whole: list[tuple[Array, FlangeFit]] = []
    for points in clouds:
        try:
            whole.append((points, fit_flange(points, standard)))
        except FlangeNotFound:
            continue
    rows: list[dict[str, float]] = []
    for parts in PARTS:
        apart, bound, stated, size = [], [], [], []
        for k, (points, fit) in enumerate(whole):
            if k % 6 == 0:
                progress(f"{parts} parts of each cloud", (PARTS.index(parts) + k / len(whole)) / len(PARTS))
            for r in range(draws):
                part = np.random.default_rng([seed, k, r]).permutation(len(points)) % parts
                try:
                    a, b = (fit_flange(points[part == i], standard) for i in (0, 1))
                except FlangeNotFound:
                    continue
                apart.append(float(((a.center_C - b.center_C) ** 2).sum()))
                stated.append(float(np.trace(a.center_covariance + b.center_covariance)))
                bound.append(center_bound(points, fit, parts) ** 2)
                size.append(len(points) // parts)
        of = {"apart_mm": apart, "bound_mm": bound, "stated_mm": stated}
        rms = {name: 1e3 * float(np.sqrt(np.mean(v))) if v else float("nan") for name, v in of.items()}
        rows.append({"parts": parts, "points": int(np.median(size)) if size else 0, **rms})
    return rows
