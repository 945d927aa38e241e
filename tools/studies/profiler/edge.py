"""The edge paper's Tables 1 to 3 and what they do not show: the calibration's own error, for its method and for the joint one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.edge.joint import edge_crb, edge_joint
from weldcal.calibration.profiler.edge.linear import edge_linear
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.tools.studies.profiler.sets import TRANSLATIONS, EdgeTrial

COUNTS = (10, 15, 20, 25)
METHODS = ("paper", "joint")
# rms rotation deg and translation mm at 25 rotations, with the joint method
TARGETS = {
    "xy_paper": (0.39, 0.50),
    "tilt_paper": (0.32, 0.40),
    "xy_nominal": (0.116, 0.14),
    "tilt_nominal": (0.107, 0.132),
}
TITLES = {
    "xy_paper": "level arcs, noise as in the paper", "tilt_paper": "tilted arcs, noise as in the paper",
    "xy_nominal": "level arcs, nominal noise", "tilt_nominal": "tilted arcs, nominal noise",
}  # fmt: skip
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


@dataclass(frozen=True)
class EdgeRow:
    """One set, number of rotations and method: rms errors over the trials, and the paper's own three criteria (mm, deg)."""

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


def edge_rows(
    name: str, trials: Iterable[EdgeTrial], progress: Callable[[float], None], counts: tuple[int, ...] = COUNTS
) -> list[EdgeRow]:
    """All rows of a set, for each of these numbers of orientations."""
    found: dict[tuple[int, str], list[Floats]] = {(n, m): [] for n in counts for m in METHODS}
    every = list(trials)
    for k, trial in enumerate(every):
        progress(k / len(every))
        for n in counts:
            few = slice(0, n * TRANSLATIONS)
            poses, points = trial.poses[few], trial.points[few]
            sigma, xz = trial.noise.robot_m, trial.noise.xz_m
            crb = edge_crb(trial.truth, poses.rotation, poses.translation, sigma_robot_m=sigma, sigma_xz_m=xz)
            bound = [np.degrees(np.sqrt(np.trace(crb[:3, :3]))), 1e3 * np.sqrt(np.trace(crb[3:, 3:]))]
            for method in METHODS:
                if method == "paper":
                    linear = edge_linear(
                        poses.rotation, poses.translation, points, np.repeat(np.arange(n), TRANSLATIONS)
                    )
                    R, t = linear.rotation, linear.translation
                else:
                    e = edge_joint(poses.rotation, poses.translation, points, sigma_robot_m=sigma, sigma_xz_m=xz)
                    R, t = e.rotation, e.translation
                off_deg = np.degrees(Rotation.from_matrix(trial.truth.rotation @ R.T).magnitude())
                off_mm = 1e3 * np.linalg.norm(t - trial.truth.translation)
                radius = _ball_radius_mm(trial, R, t)
                found[n, method].append(np.array([off_deg, off_mm, *bound, *_criteria(poses, points, R, t), radius]))
    rows = []
    for (n, method), values in found.items():
        v = np.array(values)
        rms = np.sqrt((v[:, :4] ** 2).mean(axis=0))
        alpha, alpha_std, d, d_std, radius = (float(x) for x in v[:, 4:9].mean(axis=0))
        turn, shift, crb_deg, crb_mm = (float(x) for x in rms)
        off = float(np.abs(v[:, 8] - 20.0).mean())
        rows.append(
            EdgeRow(name, n, method, len(v), turn, shift, crb_deg, crb_mm, alpha, alpha_std, d, d_std, radius, off)
        )
    return rows


def _criteria(poses: FlangePoses, points: Floats, R: Floats, t: Floats) -> tuple[float, float, float, float]:
    """Mean and std of d alpha (deg; vectors from the first point of a group, unsigned) and of d (mm), the paper's section 4.1."""
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
    """Radius of the sphere through all profiles of the ball, brought together by a calibration."""
    if trial.ball is None or trial.ball_poses is None:
        return float("nan")
    at = ball_points(trial, R, t).reshape(-1, 3)
    middle = at.mean(axis=0)
    q = at - middle
    s = np.linalg.lstsq(np.column_stack([2.0 * q, np.ones(len(q))]), np.einsum("ni,ni->n", q, q), rcond=None)[0]
    start = np.array([*s[:3], np.sqrt(s[3] + s[:3] @ s[:3])])

    def off(x: Floats) -> Floats:
        return np.asarray(np.linalg.norm(q - x[:3], axis=1) - x[3])

    found = least_squares(off, start, method="lm", x_scale=1e-2)
    return 1e3 * float(found.x[3])


def ball_points(trial: EdgeTrial, R: Floats, t: Floats) -> Floats:
    """The ball's profiles (60, m, 3) m in B by a calibration."""
    assert trial.ball is not None
    assert trial.ball_poses is not None
    p = np.stack([trial.ball[..., 0], np.zeros(trial.ball.shape[:2]), trial.ball[..., 1]], axis=2) @ R.T + t
    return np.asarray(np.einsum("nij,nmj->nmi", trial.ball_poses.rotation, p) + trial.ball_poses.translation[:, None])


def all_sets(
    trials_of: Callable[[str], Iterable[EdgeTrial]], names: tuple[str, ...], progress: Callable[[str, float], None]
) -> list[EdgeRow]:
    """Rows of the sets named."""
    rows: list[EdgeRow] = []
    for k, name in enumerate(names):

        def part(share: float, k: int = k, name: str = name) -> None:
            progress(name, (k + share) / len(names))

        rows += edge_rows(name, trials_of(name), part)
    return rows
