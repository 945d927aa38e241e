"""Tables 1 to 3 of the edge paper, and the calibration's own error, by its method and by the joint method."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import least_squares

from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.tools.worlds.edge_trials import TRANSLATIONS, EdgeTrial

COUNTS = (10, 15, 20, 25)
METHODS = ("paper", "joint")
# rms rotation deg and translation mm at 25 rotations, with the joint method
TARGETS = {
    "xy_paper": (0.39, 0.50),
    "tilt_paper": (0.32, 0.40),
    "xy_nominal": (0.116, 0.14),
    "tilt_nominal": (0.107, 0.132),
    "free_paper": (0.36, 0.42),
    "free_nominal": (0.107, 0.123),
    "outlier_nominal": (0.071, 0.095),
}
TITLES = {
    "xy_paper": "level arcs, noise as in the paper",
    "tilt_paper": "tilted arcs, noise as in the paper",
    "xy_nominal": "level arcs, nominal noise",
    "tilt_nominal": "tilted arcs, nominal noise",
    "free_paper": "40 free poses, noise as in the paper",
    "free_nominal": "40 free poses, nominal noise",
    "outlier_nominal": "a tenth of outliers",
}
# Tables 1, 2 and 3 as printed: bar, scale, blade for 10, 15, 20, 25 rotations
PRINTED_ALPHA = {10: (2.19, 3.10, 1.85), 15: (1.16, 0.74, 0.81), 20: (-1.03, 0.86, 0.84), 25: (-1.12, 0.73, 0.94)}
PRINTED_ALPHA_STD = {10: (2.55, 4.46, 2.38), 15: (2.56, 2.32, 2.08), 20: (2.67, 1.95, 1.74), 25: (2.39, 1.86, 1.66)}
PRINTED_D = {10: (0.27, 0.37, 0.27), 15: (0.28, 0.22, 0.26), 20: (0.30, 0.22, 0.26), 25: (0.31, 0.23, 0.25)}
PRINTED_D_STD = {10: (0.16, 0.19, 0.17), 15: (0.15, 0.12, 0.14), 20: (0.16, 0.14, 0.14), 25: (0.15, 0.15, 0.14)}
PRINTED_RADIUS = {
    10: (20.06, 19.99, 19.94),
    15: (19.99, 20.04, 19.92),
    20: (19.99, 19.99, 19.95),
    25: (19.99, 19.99, 19.96),
}


@dataclass(frozen=True, kw_only=True)
class EdgeRow:
    """One set, number of rotations and method: rms errors over the trials, and the paper's own three criteria (mm,
    deg)."""

    name: str
    rotations: int
    method: str
    trials: int
    rotation_deg: float
    translation_mm: float
    crb_deg: float
    crb_mm: float
    alpha_mean_deg: float
    alpha_std_deg: float
    d_mean_mm: float
    d_std_mm: float
    radius_mm: float
    radius_error_mm: float

    @property
    def met(self) -> bool | None:
        """Whether the target is met, where there is one."""
        if self.method != "joint" or self.rotations != COUNTS[-1]:
            return None
        return bool(self.rotation_deg <= TARGETS[self.name][0] and self.translation_mm <= TARGETS[self.name][1])


def edge_targets(names: Iterable[str]) -> list[tuple[str, str, float]]:
    """(what, unit, limit) of rotation and translation, for each of these sets."""
    return [
        (f"edge, {TITLES[name]}, {part}", unit, limit)
        for name in names
        for part, unit, limit in zip(("rotation", "translation"), ("deg", "mm"), TARGETS[name], strict=True)
    ]


def edge_figures(name: str, values: Iterable[float]) -> dict[str, float]:
    """Rotation and translation of a set, by the names of their targets."""
    return {what: float(value) for (what, _, _), value in zip(edge_targets([name]), values, strict=True)}


def edge_rows(
    name: str, trials: Iterable[EdgeTrial], progress: Callable[[float], None], counts: tuple[int, ...] = COUNTS
) -> list[EdgeRow]:
    """All rows of a set, for each of these numbers of orientations."""
    found: dict[tuple[int, str], list[Floats]] = {(n, m): [] for n in counts for m in METHODS}
    every = list(trials)
    for k, trial in enumerate(every):
        progress(k / len(every))
        for n in counts:
            few = trial.first(n * TRANSLATIONS)
            bound = few.bound()
            for method in METHODS:
                found_pose = few.paper() if method == "paper" else few.joint()
                R, t = found_pose.rotation, found_pose.translation
                error, radius = few.error(R, t), _ball_radius_mm(trial, R, t)
                one = (error.deg, error.mm, bound.deg, bound.mm, *_criteria(few.poses, few.points, R, t), radius)
                found[n, method].append(np.array(one))
    rows = []
    for (n, method), values in found.items():
        v = np.array(values)
        off = float(np.abs(v[:, 8] - 20.0).mean())
        figures = [*np.sqrt((v[:, :4] ** 2).mean(axis=0)).tolist(), *v[:, 4:].mean(axis=0).tolist(), off]
        columns = [field.name for field in fields(EdgeRow)]
        rows.append(EdgeRow(**dict(zip(columns, (name, n, method, len(v), *figures), strict=True))))
    return rows


def _criteria(poses: FlangePoses, points: Floats, R: Floats, t: Floats) -> tuple[float, float, float, float]:
    """Mean and std of d alpha (deg; vectors from the first point of a group, unsigned) and of d (mm), the paper's
    section 4.1."""
    p_F = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]]) @ R.T + t
    at = np.einsum("nij,nj->ni", poses.rotation, p_F) + poses.translation
    group = at.reshape(-1, TRANSLATIONS, 3)
    u = (group[:, 1:] - group[:, :1]).reshape(-1, 3)
    e = np.linalg.svd(u, full_matrices=False)[2][0]
    length = np.linalg.norm(u, axis=1)
    alpha = np.degrees(np.arccos(np.clip(np.abs(u @ e) / np.maximum(length, 1e-12), 0.0, 1.0)))
    off = at - at.mean(axis=0)
    d = 1e3 * np.linalg.norm(off - np.outer(off @ e, e), axis=1)
    return float(alpha.mean()), float(alpha.std()), float(d.mean()), float(d.std())


def _ball_radius_mm(trial: EdgeTrial, R: Floats, t: Floats) -> float:
    """Radius of the sphere through all profiles of the ball, brought into one frame by a calibration."""
    if trial.ball is None or trial.ball_poses is None:
        return float("nan")
    p = np.stack([trial.ball[..., 0], np.zeros(trial.ball.shape[:2]), trial.ball[..., 1]], axis=2) @ R.T + t
    poses = trial.ball_poses
    at = (np.einsum("nij,nmj->nmi", poses.rotation, p) + poses.translation[:, None]).reshape(-1, 3)
    middle = at.mean(axis=0)
    q = at - middle
    s = np.linalg.lstsq(np.column_stack([2.0 * q, np.ones(len(q))]), np.einsum("ni,ni->n", q, q), rcond=None)[0]
    start = np.array([*s[:3], np.sqrt(s[3] + s[:3] @ s[:3])])

    def off(x: Floats) -> Floats:
        return np.asarray(np.linalg.norm(q - x[:3], axis=1) - x[3])

    found = least_squares(off, start, method="lm", x_scale=1e-2)
    return 1e3 * float(found.x[3])
