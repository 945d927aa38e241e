"""Edge trials of the profiler study: poses, points and truth, from the fixed files or made from seeds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.edge.joint import EdgeEstimate, _system, edge_joint
from weldcal.calibration.profiler.edge.linear import EdgeLinear, edge_linear
from weldcal.calibration.profiler.edge.model import EdgeState, left_covariance, predicted
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.models.errors import InputError

MM = 1e-3
ROTATIONS, TRANSLATIONS, FREE = 25, 10, 40
BALL_M = 0.020


@dataclass(frozen=True)
class EdgeNoise:
    """One sigma of the robot per axis and of a profile point in x and z, and the step z is rounded to (m)."""

    robot_m: float
    x_m: float
    z_m: float
    step_m: float = 0.1 * MM

    @property
    def xz_m(self) -> Floats:
        """(2,), with what rounding adds."""
        return np.array([self.x_m, np.hypot(self.z_m, self.step_m / np.sqrt(12.0))])


NOISE = {"nominal": EdgeNoise(0.03 * MM, 0.046 * MM, 0.05 * MM), "paper": EdgeNoise(0.06 * MM, 0.16 * MM, 0.16 * MM)}
SETS = ("xy_paper", "tilt_paper", "xy_nominal", "tilt_nominal")


class EdgeError(NamedTuple):
    """Error of a calibration.

    Rotation deg, translation mm, normalised error squared of six numbers (NaN without covariance).
    """

    deg: float
    mm: float
    nees: float = float("nan")


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeTrial:
    """One calibration by an edge.

    Attributes:
        poses, points: flange poses (n) as reported and profile points (n, 2) m, usually 25 rotations of 10
            translations.
        truth, noise: of these.
        ball_poses, ball: profiles of a ball (60, m, 2) m on which the result is tried, and the flange poses.
        wrong: (n,) which points are outliers, where some are.
    """

    poses: FlangePoses
    points: Floats
    truth: EdgeState
    noise: EdgeNoise
    ball_poses: FlangePoses | None = None
    ball: Floats | None = None
    wrong: NDArray[np.bool_] | None = None

    def first(self, count: int) -> EdgeTrial:
        """Return the trial with its first poses only."""
        return replace(self, poses=self.poses[slice(0, count)], points=self.points[:count])

    def joint(self, init: EdgeState | None = None) -> EdgeEstimate:
        """Return the joint method's calibration."""
        X, noise = self.poses, self.noise
        return edge_joint(
            X.rotation, X.translation, self.points, sigma_robot_m=noise.robot_m, sigma_xz_m=noise.xz_m, init=init
        )

    def paper(self) -> EdgeLinear:
        """Return the calibration by the paper's method."""
        group = np.repeat(np.arange(len(self.poses) // TRANSLATIONS), TRANSLATIONS)
        return edge_linear(self.poses.rotation, self.poses.translation, self.points, group)

    def crb(self) -> Floats:
        """Return the Cramer-Rao bound (6, 6) of a calibration from the poses that are no outliers."""
        X = self.poses if self.wrong is None else self.poses[~self.wrong]
        return edge_crb(
            self.truth, X.rotation, X.translation, sigma_robot_m=self.noise.robot_m, sigma_xz_m=self.noise.xz_m
        )

    def bound(self) -> EdgeError:
        """Return the Cramer-Rao bound, as standard deviations of rotation and translation."""
        return sigma_of(self.crb())

    def error(self, rotation: Floats, translation: Floats, covariance: Floats | None = None) -> EdgeError:
        """Return the error of a calibration."""
        turn = Rotation.from_matrix(self.truth.rotation @ rotation.T).as_rotvec()
        off = np.concatenate([turn, self.truth.translation - translation])
        nees = np.nan if covariance is None else float(off @ np.linalg.solve(covariance, off))
        return EdgeError(float(np.degrees(np.linalg.norm(turn))), float(np.linalg.norm(off[3:])) / MM, nees)


def sigma_of(covariance: Floats) -> EdgeError:
    """Standard deviations of rotation and translation from a covariance (6, 6)."""
    turn, shift = np.sqrt(np.trace(covariance[:3, :3])), np.sqrt(np.trace(covariance[3:, 3:]))
    return EdgeError(float(np.degrees(turn)), float(shift) / MM)


def rms(errors: Sequence[EdgeError]) -> tuple[float, float]:
    """Root mean squares of rotations (deg) and translations (mm); NaN for none."""
    if not errors:
        return float("nan"), float("nan")
    deg, mm = (float(np.sqrt(np.mean([e[k] ** 2 for e in errors]))) for k in (0, 1))
    return deg, mm


def fixed_edge_trials(folder: Path, name: str) -> Iterator[EdgeTrial]:
    """Of the fixed files; the ball of five trials goes round.

    Raises:
        InputError: the files are not there.
    """
    files = folder / "edge_features.npz", folder / "edge_sphere.npz"
    for path in files:
        if not path.is_file():
            raise InputError(f"There is no {path.name} in '{folder}': omit --data to make trials from seeds.")
    kind, level = name.split("_")
    of = {"free": f"free40_{level}", "outlier": f"outlier10_{level}"}.get(kind, f"grid_{name}")
    with np.load(files[0]) as d, np.load(files[1]) as b:
        truth = EdgeState(d["truth_Rs"], d["truth_Ts"] * MM, d["truth_p0"] * MM, d["truth_e"])
        R, t, p = d[f"{of}_Rb"], d[f"{of}_Tb"] * MM, d[f"{of}_ps"] * MM
        wrong = d[f"{of}_outlier"] if kind == "outlier" else None
        ball_R, ball_t, ball = b[f"{level}_Rb"], b[f"{level}_Tb"] * MM, b[f"{level}_prof"].astype(float) * MM
    for k in range(len(R)):
        j = k % len(ball)
        yield EdgeTrial(
            poses=FlangePoses(R[k], t[k]),
            points=p[k],
            truth=truth,
            noise=NOISE[level],
            ball_poses=FlangePoses(ball_R[j], ball_t[j]),
            ball=ball[j],
            wrong=None if wrong is None else wrong[k],
        )


def made_edge_trials(name: str, count: int, seed: int) -> Iterator[EdgeTrial]:
    """Made from seeds, as the fixed files were: the scanner's pose and the edge are theirs, poses and noise are not.

    Besides `SETS`: free_paper, free_nominal (40 poses, all different), outlier_nominal (every tenth point is 1 to 8 mm
    off).
    """
    kind, level = name.split("_")
    make = {"free": _free, "outlier": _outlier}.get(kind, _arcs)
    for k in range(count):
        rng = np.random.default_rng([seed, k, *name.encode()])
        yield make(kind, NOISE[level], rng)


def _truth() -> EdgeState:
    """Of the fixed files."""
    e = np.array([np.cos(np.radians(31.0)), np.sin(np.radians(31.0)), 0.12])
    return EdgeState(
        Rotation.from_euler("ZYX", [37.0, -12.0, 168.0], degrees=True).as_matrix(),
        np.array([0.062, -0.028, 0.141]),
        np.array([1.05, 0.18, 0.32]),
        e / np.linalg.norm(e),
    )


def _above(e: Floats) -> Floats:
    """Orientation (3, 3) of a scanner that looks down on an edge across its laser line."""
    down = np.array([0.0, 0.0, -1.0])
    x = np.cross(e, down)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(down, x), down])


def _free(_kind: str, noise: EdgeNoise, rng: np.random.Generator) -> EdgeTrial:
    """40 poses all different, over the whole field of view."""
    truth = _truth()
    R: list[Floats] = []
    t: list[Floats] = []
    while len(R) < FREE:
        turn = Rotation.from_euler("ZYX", rng.uniform(-1, 1, 3) * [62.0, 35.0, 35.0], degrees=True).as_matrix()
        R_BF = _above(truth.direction) @ turn @ truth.rotation.T
        if abs(truth.direction @ R_BF @ truth.rotation[:, 1]) < 0.45:
            continue
        p_S = np.array([rng.uniform(-0.018, 0.018), 0.0, rng.uniform(0.060, 0.092)])
        R.append(R_BF)
        at = truth.point + rng.uniform(-0.07, 0.07) * truth.direction
        t.append(at - R_BF @ (truth.rotation @ p_S + truth.translation))
    return _observed(FlangePoses(np.array(R), np.array(t)), truth, noise, rng)


def _outlier(_kind: str, noise: EdgeNoise, rng: np.random.Generator) -> EdgeTrial:
    """Tilted arcs, one point in ten off by 1 to 8 mm."""
    trial = _arcs("tilt", noise, rng)
    wrong = rng.random(len(trial.points)) < 0.1
    trial.points[wrong, 0] += rng.choice([-1.0, 1.0], wrong.sum()) * rng.uniform(1e-3, 8e-3, wrong.sum())
    return replace(trial, wrong=wrong)


def _observed(poses: FlangePoses, truth: EdgeState, noise: EdgeNoise, rng: np.random.Generator) -> EdgeTrial:
    points = _noisy(predicted(truth, poses)[0], noise, rng)
    reported = FlangePoses(
        poses.rotation, poses.translation + noise.robot_m * rng.standard_normal(poses.translation.shape)
    )
    return EdgeTrial(poses=reported, points=points, truth=truth, noise=noise)


def _arcs(arc: str, noise: EdgeNoise, rng: np.random.Generator) -> EdgeTrial:
    """25 orientations of an arc of ten positions each."""
    truth = _truth()
    above = _above(truth.direction)
    R: list[Floats] = []
    t: list[Floats] = []
    while len(R) < ROTATIONS:
        turn = Rotation.from_euler("ZYX", rng.uniform(-1, 1, 3) * [45.0, 25.0, 25.0], degrees=True).as_matrix()
        R_BF = above @ turn @ truth.rotation.T
        middle = np.array([rng.uniform(-0.004, 0.004), 0.0, rng.uniform(0.072, 0.080)])
        at = truth.point + rng.uniform(-0.008, 0.008) * truth.direction
        begin = rng.uniform(0, 2 * np.pi)
        angle = begin + np.radians(np.linspace(-120.0, 120.0, TRANSLATIONS))
        circle = 0.014 * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(TRANSLATIONS)])
        circle -= 0.014 * np.array([np.cos(begin), np.sin(begin), 0.0])
        if arc == "tilt":
            circle = circle @ Rotation.from_euler("xy", rng.uniform(-30.0, 30.0, 2), degrees=True).as_matrix().T
        p_BF = at - R_BF @ (truth.rotation @ middle + truth.translation) + circle
        X = FlangePoses(np.repeat(R_BF[None], TRANSLATIONS, 0), p_BF)
        p, _, _ = predicted(truth, X)
        seen = (np.abs(p[:, 0]) < 0.020) & (p[:, 1] > 0.058) & (p[:, 1] < 0.095)
        if seen.all() and abs(truth.direction @ R_BF @ truth.rotation[:, 1]) > 0.45:
            R.append(X.rotation)
            t.append(X.translation)
    poses = FlangePoses(np.concatenate(R), np.concatenate(t))
    trial = _observed(poses, truth, noise, rng)
    ball_poses, ball = _ball(truth, noise, rng)
    return replace(trial, ball_poses=ball_poses, ball=ball)


def _noisy(p: Floats, noise: EdgeNoise, rng: np.random.Generator) -> Floats:
    q = p + rng.standard_normal(p.shape) * [noise.x_m, noise.z_m]
    q[..., 1] = np.round(q[..., 1] / noise.step_m) * noise.step_m
    return np.asarray(q)


def _ball(truth: EdgeState, noise: EdgeNoise, rng: np.random.Generator) -> tuple[FlangePoses, Floats]:
    """Ten orientations of six cuts of a ball where the edge was."""
    down = np.diag([1.0, -1.0, -1.0])
    turn = Rotation.from_euler("ZYX", rng.uniform(-1, 1, (10, 3)) * [60.0, 15.0, 15.0], degrees=True).as_matrix()
    R = np.repeat(down @ turn @ truth.rotation.T, 6, axis=0)
    c = np.column_stack(
        [rng.uniform(-0.003, 0.003, 60), np.tile(np.linspace(-0.011, 0.011, 6), 10), rng.uniform(0.083, 0.089, 60)]
    )
    t = truth.point - np.einsum("nij,nj->ni", R, c @ truth.rotation.T + truth.translation)
    r = np.sqrt(BALL_M**2 - c[:, 1:2] ** 2)
    a = np.linspace(-0.9, 0.9, 60)
    p = np.stack([c[:, :1] + r * np.sin(a), c[:, 2:] - r * np.cos(a)], axis=2)
    return FlangePoses(R, t + noise.robot_m * rng.standard_normal(t.shape)), _noisy(p, noise, rng)


def edge_crb(
    state: EdgeState, rotation: ArrayLike, translation: ArrayLike, *, sigma_robot_m: float, sigma_xz_m: ArrayLike
) -> Floats:
    """Cramer-Rao bound (6, 6) of [rotation in F.

    Translation] for these poses and sigmas: no unbiased method does better.
    """
    poses = FlangePoses.checked(rotation, translation)
    p, _, _ = predicted(state, poses)
    _, _, J = _system(state, poses, p, sigma_robot_m, np.asarray(sigma_xz_m, float))
    flat = J.reshape(-1, 10)
    return left_covariance(state.rotation, np.asarray(np.linalg.pinv(flat.T @ flat)))
