"""The covariance of half a face and of holes off their places is that of the errors: scans and faces by rays and
formulas."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.calibration.flange.raycast import BORE, CHAMFER, CIRCLE, HOLES, OUTER, facing
from weldcal.calibration.flange.fit import FlangeFit, FlangeGuess, fit_flange
from weldcal.calibration.flange.holes import find_holes
from weldcal.models.flanges import get_flange

Array = NDArray[np.float64]

STANDARD = get_flange("iso9409-1-50-4-m6")
NOISE_M = 3e-5
OUT_OF_ROUND_M = 7e-5  # per axis, of the circle through half an edge: halves of recorded clouds against the whole ones
HARMONICS = np.arange(2, 6)


def _wave(rng: np.random.Generator) -> Array:
    """Amplitudes (2, 4) m of cos and sin of an edge's harmonics that move the circle through half of it by
    OUT_OF_ROUND_M per axis."""
    half = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 181)
    circle = np.column_stack([np.cos(half), np.sin(half), np.ones_like(half)])
    waves = np.column_stack([f(k * half) for k in HARMONICS for f in (np.cos, np.sin)])
    moved = (np.linalg.pinv(circle) @ waves)[:2]  # centre by amplitude
    unit = np.sqrt((moved**2).sum() / 2.0)
    return np.asarray(rng.normal(size=(2, len(HARMONICS))) * OUT_OF_ROUND_M / unit)


def _scan(X_CR: Array, rng: np.random.Generator, *, half: bool) -> Array:
    """An organised scan (H, W, 3) m of a face whose edges are out of round, a floor behind; of the right half only, or
    of all."""
    focal, p = 1000.0, X_CR[:3, 3]
    u, v = np.meshgrid(
        np.arange(-100, 101) + round(focal * p[0] / p[2]), np.arange(-100, 101) + round(focal * p[1] / p[2])
    )
    rays = np.stack([u / focal, v / focal, np.ones_like(u, dtype=float)], axis=-1)
    z = X_CR[:3, 2]
    depth = (z @ p) / (rays @ z)
    x, y = ((rays * depth[..., None] - p) @ X_CR[:3, k] for k in (0, 1))
    turn, rho = np.arctan2(y, x), np.hypot(x, y)
    a = _wave(rng)
    edge = sum(a[0, i] * np.cos(k * turn) + a[1, i] * np.sin(k * turn) for i, k in enumerate(HARMONICS))
    face = (rho < OUTER - CHAMFER + edge) & (rho > BORE + CHAMFER + edge)
    depth = np.where(face, depth, 1.2)
    cloud = rays * (depth + NOISE_M * rng.normal(size=depth.shape))[..., None]
    if half:  # where x is negative, something else hides the face
        cloud[(rho < 0.05) & (x < 0.0)] = np.nan
    return np.asarray(cloud)


def _fits(n: int, *, half: bool) -> list[tuple[FlangeFit, Array]]:
    found = []
    for seed in range(n):
        rng = np.random.default_rng([8, seed])
        p = np.array([rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), rng.uniform(0.45, 0.6)])
        X_CR = facing(p, np.radians(rng.uniform(0.0, 20.0)), rng.uniform(0, 6.3), rng.uniform(0, 6.3))
        guess = FlangeGuess(p, 0.08, X_CR[:3, 2])
        found.append((fit_flange(_scan(X_CR, rng, half=half), STANDARD, guess=guess), X_CR))
    return found


def _in_face(fit: FlangeFit, X_CR: Array) -> tuple[Array, Array]:
    """Error (3,) m and covariance (3, 3) m^2 of the centre in the flange's frame."""
    R = X_CR[:3, :3]
    return R.T @ (fit.center_C - X_CR[:3, 3]), R.T @ fit.center_covariance @ R


def test_half_a_face_is_as_far_off_in_it_as_stated() -> None:
    found = []
    for fit, X_CR in _fits(40, half=True):
        assert 0.4 < fit.coverage < 0.6
        e, C = _in_face(fit, X_CR)
        found.append(e[:2] @ np.linalg.solve(C[:2, :2], e[:2]) / 2.0)
    # 80 degrees of freedom: 16 %. Without the edges' part it is above 2, with twice its sigma below 0.4
    assert 0.6 < np.mean(found) < 1.6


def test_a_whole_face_is_as_high_and_as_level_as_stated() -> None:
    found, tilt = [], []
    for fit, X_CR in _fits(60, half=False):
        assert fit.coverage > 0.9
        e, C = _in_face(fit, X_CR)
        found.append(e[2] ** 2 / C[2, 2])
        lean = X_CR[:3, :2].T @ fit.normal_C
        tilt.append(lean @ lean / 2.0 / fit.normal_sigma**2)
    # 60 and 120 degrees of freedom: 18 and 13 %
    assert 0.5 < np.mean(found) < 1.7
    assert 0.6 < np.mean(tilt) < 1.5


def _drilled(rng: np.random.Generator, off_m: float) -> tuple[Array, float]:
    """Points (N, 3) m of a face 0.5 m away, its holes off their places by ``off_m`` per axis, and the turn of the
    pattern (rad)."""
    pitch, reach = 4e-4, 80
    j, i = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    xy = np.column_stack([(i + 0.5 * (j % 2)).ravel(), np.sqrt(0.75) * j.ravel()]) * pitch
    rho = np.hypot(*xy.T)
    keep = (rho < OUTER - CHAMFER) & (rho > BORE + CHAMFER)
    turn = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    for x, y, r in HOLES:
        dx, dy = off_m * rng.normal(size=2)
        keep &= np.hypot(xy[:, 0] - (c * x - s * y + dx), xy[:, 1] - (s * x + c * y + dy)) > r
    points = np.column_stack([xy[keep], np.zeros(int(keep.sum()))]) + NOISE_M * rng.normal(size=(int(keep.sum()), 3))
    return points * [1.0, -1.0, -1.0] + [0.02, -0.03, 0.5], turn


def test_holes_off_their_places_say_how_well_they_know_the_turn() -> None:
    """Five holes, each 0.1 mm off per axis: the turn is off by 0.1 mm over the root of five at the circle, as six
    numbers to spare show."""
    square = []
    for seed in range(70):
        points, turn = _drilled(np.random.default_rng([9, seed]), 1e-4)
        fit = fit_flange(points, STANDARD)
        pattern = find_holes(points, fit, STANDARD)
        assert pattern is not None
        assert pattern.turn_known
        x = pattern.X_CR.rotation().matrix()[:, 0]
        e = np.angle(np.exp(1j * (np.arctan2(-x[1], x[0]) - turn)))
        square.append((e / pattern.turn_sigma) ** 2)
        assert abs(e) < 5.0 * 1e-4 / np.sqrt(5.0) / CIRCLE
    # the median of F (1, 6) is 0.51; binomial of 70: 6 %
    assert 0.32 < np.mean(np.array(square) < 0.515) < 0.68
