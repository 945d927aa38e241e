"""Pairs of poses with a right and a wrong scale of the camera's distances: how often the scale is named, counted.

python -m tests.calibration.hand_eye.scale_sets --sets 1000
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.hand_eye.mistakes import wrong_scale
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.solve import CameraScale, HandEyeConfig, solve_problem

QUICK = HandEyeConfig(folds=0)


def rigid(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, t
    return X


def pairs(
    rng: np.random.Generator, n: int, scale: float, deg: float, mm: float, shift: float = 0.12, turn: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flange poses and board poses (n, 4, 4) of an eye in hand, the board's positions times the scale, and X (4, 4).

    Each board pose is off by deg and mm per axis.
    """
    X = rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.1, 0.1, 3))
    board = rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform([0.1, -0.5, -0.5], [1.1, 0.5, 0.5]))
    F, G = [], []
    for _ in range(n):
        tilt = Rotation.from_rotvec(rng.uniform(-turn, turn, 3)).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        away = (
            rng.uniform([-shift, -shift, 0.3 - shift], [shift, shift, 0.6 + shift])
            if shift
            else np.array([0.0, 0.0, 0.4])
        )
        camera = rigid(tilt, away)
        off = rigid(
            Rotation.from_rotvec(np.radians(deg) * rng.standard_normal(3)).as_matrix(),
            1e-3 * mm * rng.standard_normal(3),
        )
        F.append(board @ camera @ np.linalg.inv(X))
        G.append(np.linalg.inv(camera) @ off)
    G_of = np.array(G)
    G_of[:, :3, 3] *= scale
    return np.array(F), G_of, X


def named(F: np.ndarray, G: np.ndarray) -> CameraScale | None:
    problem = full_problem(F, G)
    return wrong_scale(problem, solve_problem(problem, config=QUICK), QUICK)


def independent_sigma(F: np.ndarray, G: np.ndarray, X: np.ndarray, deg: float, mm: float) -> float:
    """Sigma of the scale for known noise, by a numerical Jacobian of all poses and the scale: no code of weldcal.

    Unknown are X, the board's place and the logarithm of the scale.
    """
    board = F[0] @ X @ G[0]

    def residual(v: np.ndarray) -> np.ndarray:
        A = X @ rigid(Rotation.from_rotvec(v[:3]).as_matrix(), v[3:6])
        B = board @ rigid(Rotation.from_rotvec(v[6:9]).as_matrix(), v[9:12])
        rows = []
        for f, g in zip(F, G, strict=True):
            scaled = g.copy()
            scaled[:3, 3] *= np.exp(v[12])
            D = np.linalg.inv(B) @ f @ A @ scaled
            rows += [Rotation.from_matrix(D[:3, :3]).as_rotvec() / np.radians(deg), D[:3, 3] / (1e-3 * mm)]
        return np.concatenate(rows)

    J = np.column_stack([(residual(h) - residual(-h)) / 2e-5 for h in 1e-5 * np.eye(13)])
    return float(np.sqrt(np.linalg.inv(J.T @ J)[12, 12]))


def counted(sets: int, seed: int) -> Counter[str]:
    """What is said of sets of 8 to 40 poses, half of them right, half 0.5 to 5 % wrong."""
    counts: Counter[str] = Counter()
    for k in range(sets):
        rng = np.random.default_rng([seed, k])
        n, deg, mm = int(rng.integers(8, 41)), rng.uniform(0.02, 0.4), rng.uniform(0.1, 2.0)
        turn = rng.uniform(0.25, 0.7)
        if k % 2 == 0:
            F, G, _ = pairs(rng, n, 1.0, deg, mm, turn=turn)
            counts["right"] += 1
            counts["right, named (false)"] += named(F, G) is not None
            continue
        wrong = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.005, 0.05))
        F, G, X = pairs(rng, n, 1.0 + wrong, deg, mm, turn=turn)
        true = G.copy()
        true[:, :3, 3] /= 1.0 + wrong
        far = abs(wrong) > 4.0 * independent_sigma(F, true, X, deg, mm)
        found = named(F, G)
        counts[f"wrong by {'more' if far else 'less'} than 4 sigmas"] += 1
        counts[f"wrong by {'more' if far else 'less'} than 4 sigmas, named"] += found is not None
        if found is not None:
            before = solve_problem(full_problem(F, G), config=QUICK).X.translation() - X[:3, 3]
            after = found.poses["X"].translation() - X[:3, 3]
            counts["named, X nearer with the factor"] += bool(np.linalg.norm(after) < np.linalg.norm(before))
            counts["named"] += 1
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    a = parser.parse_args()
    for name, n in sorted(counted(a.sets, a.seed).items()):
        print(f"{name:40s}{n:6d}")


if __name__ == "__main__":
    main()
