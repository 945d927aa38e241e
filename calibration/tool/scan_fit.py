"""Fits a surface of a tool to scans from several poses, with the errors of calibration, arm and scanner as unknowns.

Gauss-Newton with Tukey's weights. The calibration's error has the covariance of its result. Each scan may be shifted
and turned as a whole; how much is estimated with the noise (variance components: Harville, Maximum likelihood
approaches to variance component estimation, JASA 72, 1977).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from pydrake.math import RigidTransform
from scipy.sparse import csr_array

from weldcal.calibration.errors import ToolNotFound
from weldcal.calibration.geometry.robust import MAD, TUKEY, chi2_quantile, f_quantile
from weldcal.calibration.tool.surfaces import Surface
from weldcal.models.arrays import Array

STEPS = 25
FEWEST_SCANS = 3  # fewer do not show how far the scans differ
FEWEST_CELLS = 8
FEWEST_POINTS = 3  # of a cell
_STEEPEST_DEG = 65.0  # a choice: of the ray against the normal; points nearer to the outline are blurred
_SHIFT_M, _TURN_RAD = 2e-5, 5e-5  # least deviations of a scan: an arm's repeatability, 0.03 mm, and 0.003 degrees
_NOISE_M = 5e-6  # least deviation of a cell's mean
_SETTLING, _SETTLED = 8, 1e-6  # steps in which the scale narrows, and a step in m or rad that changes nothing
_EXACT_M, _EXACT_RAD = 1e-6, 1e-6  # of a calibration that states no error

S = TypeVar("S", bound=Surface)


@dataclass(frozen=True, eq=False)
class ToolScan:
    """A scan of the tool: corrected points (N, 3) m in F, the pose X_FB and the camera's place (3,) m in B."""

    id: str
    p_F: Array
    X_FB: RigidTransform
    p_BC: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfaceFit(Generic[S]):
    """A fitted surface.

    ``covariance`` (P, P) of its parameters; it is widened so that its 95 % region is right for few scans. ``points``
    (N, 3) m in F on the surface, ``noise_m`` of a cell's mean, ``scans`` that show it.
    """

    surface: S
    covariance: Array
    points: Array
    noise_m: float
    scans: int
    cells: int


@dataclass(frozen=True, eq=False)
class _Rows:
    e: Array  # (M,) m
    J: Array  # (M, P + 6 + 6 n)
    on: Array  # points on the surface


@dataclass(frozen=True)
class _Spread:
    """Deviations of a scan's turn (rad) and shift (m) and of a cell's mean (m); first a guess."""

    turn: float = 1e-3
    shift: float = 1e-4
    noise: float = 1e-4


def fit_surface(start: S, scans: Sequence[ToolScan], covariance: Array, what: str) -> SurfaceFit[S]:
    """Fit a surface to scans; ``covariance`` (6, 6) of X_BC as in a result, ``what`` names the surface.

    Raises:
        ToolNotFound: too few scans show it.
    """
    surface, scale, P = start, 0.0, start.size
    about = [s.p_F[np.linalg.norm(s.p_F - start.middle, axis=1) < start.around_m] for s in scans]
    cropped = [replace(s, p_F=p) for s, p in zip(scans, about, strict=True)]
    seen = [s for s in cropped if int(np.count_nonzero(start.near(s.p_F))) >= FEWEST_CELLS]
    if len(seen) < FEWEST_SCANS:
        raise ToolNotFound(
            f"{len(seen)} scans show the {what} where the tool file has it, and {FEWEST_SCANS} are needed. Scan it from"
            " more sides, or correct the tool file."
        )
    prior = np.linalg.inv(covariance + np.diag(np.repeat([_EXACT_RAD, _EXACT_M], 3) ** 2))
    spread = _Spread()
    n = len(seen)
    nuisance: Array = np.zeros(6 + 6 * n)
    C: Array = np.eye(P + len(nuisance))
    on = np.zeros((0, 3))
    for step in range(STEPS):
        rows, scale = _rows(surface, seen, nuisance, scale)
        if len(rows.e) < P + FEWEST_CELLS:
            raise ToolNotFound(
                f"Too few points lie on the {what}: scan it nearer and from more sides, or correct the tool file."
            )
        N = rows.J.T @ rows.J / spread.noise**2
        held = surface.prior()
        N[:P, :P] += held.T @ held
        weights = np.zeros((len(nuisance), len(nuisance)))
        weights[:6, :6] = prior
        weights[6:, 6:] = np.diag(np.tile(np.repeat([spread.turn, spread.shift], 3) ** -2.0, n))
        N[P:, P:] += weights
        g = rows.J.T @ rows.e / spread.noise**2
        g[P:] += weights @ nuisance
        C = np.asarray(np.linalg.inv(N + 1e-9 * np.diag(np.diag(N))), dtype=np.float64)
        x = -C @ g
        surface, nuisance, on = surface.moved(x[:P]), nuisance + x[P:], rows.on
        spread = _spread(rows, x, C, nuisance[6:], spread.noise)
        if step > _SETTLING and float(np.abs(x[:P]).max()) < _SETTLED:
            break
    widened = 3.0 * f_quantile(0.95, 3, max(2 * n - 4, 2)) / chi2_quantile(0.95, 3)
    return SurfaceFit(
        surface=surface, covariance=widened * C[:P, :P], points=on, noise_m=spread.noise, scans=n, cells=len(rows.e)
    )


def _spread(rows: _Rows, x: Array, C: Array, own: Array, noise: float) -> _Spread:
    """Estimate the variance components anew, from what a step ``x`` with covariance ``C`` left."""
    moved, variance = own.reshape(-1, 2, 3), np.diag(C)[-len(own) :].reshape(-1, 2, 3)
    turn, shift = np.sqrt((moved**2 + variance).mean(axis=(0, 2)))
    left = rows.e + rows.J @ x
    used = float(np.einsum("ij,ij->", rows.J @ C, rows.J)) / noise**2  # unknowns that the cells pay for
    now = float(np.sqrt(left @ left / max(len(left) - used, 1.0)))
    return _Spread(max(float(turn), _TURN_RAD), max(float(shift), _SHIFT_M), max(now, _NOISE_M))


def _rows(surface: Surface, scans: Sequence[ToolScan], nuisance: Array, scale: float) -> tuple[_Rows, float]:
    """Return the mean rows of the cells, and the scale of single points; ``scale`` 0: not known yet."""
    found = []
    for k, scan in enumerate(scans):
        near = surface.near(scan.p_F)
        p = scan.p_F[near]
        own = nuisance[6 + 6 * k : 12 + 6 * k]
        R_FB = scan.X_FB.rotation().matrix()
        p_B = scan.X_FB.inverse() @ p.T
        arm = np.asarray(p_B).T.reshape(-1, 3) - scan.p_BC
        p = p + (np.cross(nuisance[:3], arm) + nuisance[3:6]) @ R_FB.T + np.cross(own[:3], p - surface.middle) + own[3:]
        e, normal, J = surface.rows(p)
        ray = p - np.asarray(scan.X_FB @ scan.p_BC)
        facing = -np.einsum("ij,ij->i", ray, normal) / np.linalg.norm(ray, axis=1)
        good = facing > np.cos(np.radians(_STEEPEST_DEG))
        found.append((k, p[good], e[good], normal[good], J[good], arm[good], R_FB))
    every = np.concatenate([f[2] for f in found])
    if not len(every):
        return _Rows(np.zeros(0), np.zeros((0, 1)), np.zeros((0, 3))), scale
    now = max(MAD * float(np.median(np.abs(every))), 1e-5)
    scale = now if scale == 0.0 else max(min(now, scale), 0.5 * scale)  # narrows step by step
    out_e, out_J, on = [], [], []
    for k, p, e, normal, J, arm, R_FB in found:
        w = np.maximum(1.0 - (e / (TUKEY * scale)) ** 2, 0.0) ** 2
        keep = w > 0.0
        if not keep.any():
            continue
        p, e, normal, J, arm, w = p[keep], e[keep], normal[keep], J[keep], arm[keep], w[keep]
        n_B, off = normal @ R_FB, p - surface.middle
        full = np.hstack([e[:, None], J, np.cross(arm, n_B), n_B, np.cross(off, normal), normal])
        _, cell = np.unique(surface.cells(p) @ np.array([1 << 20, 1]), return_inverse=True)
        weight = np.bincount(cell, w)
        sums = csr_array((w, (cell, np.arange(len(cell))))) @ full
        many = (np.bincount(cell) >= FEWEST_POINTS) & (weight > 1.0)
        mean = sums[many] / weight[many, None]
        own_J = np.zeros((len(mean), surface.size + 6 + 6 * len(scans)))
        own_J[:, : surface.size + 6] = mean[:, 1 : surface.size + 7]
        own_J[:, surface.size + 6 + 6 * k : surface.size + 12 + 6 * k] = mean[:, surface.size + 7 :]
        out_e.append(mean[:, 0])
        out_J.append(own_J)
        on.append(p)
    if not out_e:
        return _Rows(np.zeros(0), np.zeros((0, 1)), np.zeros((0, 3))), scale
    return _Rows(np.concatenate(out_e), np.concatenate(out_J), np.concatenate(on)), scale
