"""Several cameras solved together beside each by itself: made worlds with a wrong arm, and a public cell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.calibration.hand_eye.made_boards import LINKS, READY, forward, joints
from tests.calibration.hand_eye.rendering import se3
from tests.figures.harness import Run, figure
from weldcal.calibration.geometry.se3 import difference
from weldcal.calibration.hand_eye.pairs.files import PosePairs, read_pairs
from weldcal.calibration.hand_eye.problem import full_problem
from weldcal.calibration.hand_eye.several import SensorPairs, SensorsTogether, solve_together
from weldcal.calibration.hand_eye.solve import HandEyeConfig, solve_problem
from weldcal.models.arrays import Array
from weldcal.models.errors import WeldcalError

REGION = float(chi2.ppf(0.95, 6))
GRID = 0.03 * (np.array([[j, i, 0.0] for i in range(5) for j in range(7)]) - [3.0, 2.0, 0.0])
FOCAL, MIDDLE = 1400.0, np.array([960.0, 600.0])
FROM = [np.array([0.8, -0.5, 0.5]), np.array([0.8, 0.6, 0.4])]  # of the cameras, m, from where the arm holds the board


def facing(p: Array, z: Array) -> Array:
    """Pose (4, 4) at p with its third axis along z."""
    z = z / np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = np.column_stack([x, np.cross(z, x), z]), p
    return X


def made(seed: int, *, corners: bool, n: int = 15, mm: float = 0.3, px: float = 0.1) -> tuple[list[PosePairs], Array]:
    """Two cameras beside an arm whose links are off by ``mm``; a board on its flange; and X_C1C2 (4, 4).

    Poses of the board follow from corners with noise, by OpenCV. With ``corners`` these are given, and the principal
    point of each camera is off by some pixels. Two of three poses are of both cameras.
    """
    rng = np.random.default_rng(seed)
    links = LINKS + 1e-3 * mm * rng.normal(size=LINKS.shape) * [1.0, 1.0, 0.0]
    links[:, 2] += rng.normal(0.0, np.radians(0.1 * mm), 6)
    zero = rng.normal(0.0, np.radians(0.1 * mm), 6)
    start = forward(READY, LINKS)
    X = [facing(start[:3, 3] + p, -p) @ se3(rng.normal(0, 0.03, 3), rng.normal(0, 0.02, 3)) for p in FROM]
    Y = np.linalg.inv(start) @ facing(start[:3, 3] + 0.1 * FROM[0], FROM[0] + FROM[1])
    K = np.array([[FOCAL, 0.0, MIDDLE[0]], [0.0, FOCAL, MIDDLE[1]], [0.0, 0.0, 1.0]])
    off = rng.normal(0.0, 2.0, (2, 2)) if corners else np.zeros((2, 2))
    robot: list[list[Array]] = [[], []]
    camera: list[list[Array]] = [[], []]
    img: list[list[Array]] = [[], []]
    while min(map(len, robot)) < n:
        B = start.copy()
        B[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.35, 3)).as_matrix() @ start[:3, :3]
        B[:3, 3] += rng.uniform(-0.15, 0.15, 3)
        q = joints(B)
        if q is None:
            continue
        stated = B @ np.linalg.inv(forward(q + zero, links)) @ forward(q, LINKS)
        lone = int(rng.integers(0, 6))
        for k in range(2):
            C = np.linalg.inv(X[k]) @ B @ Y
            p = GRID @ C[:3, :3].T + C[:3, 3]
            if len(robot[k]) == n or lone == k or C[2, 2] > -0.35 or p[:, 2].min() < 0.3:
                continue
            uv = FOCAL * p[:, :2] / p[:, 2:] + MIDDLE + off[k] + rng.normal(0.0, px, (len(p), 2))
            ok, turned, shift = cv2.solvePnP(GRID, uv, K, None)
            M = np.eye(4)
            M[:3, :3], M[:3, 3] = cv2.Rodrigues(turned)[0], shift[:, 0]
            if ok:
                robot[k].append(stated)
                camera[k].append(M)
                img[k].append(uv)
    pairs = [
        PosePairs(
            source=f"camera{k + 1}",
            robot=np.array(robot[k]),
            camera=np.array(camera[k]),
            mode="eye_on_base",
            img=np.array(img[k]) if corners else None,
            obj=GRID if corners else None,
            K=K if corners else None,
            dist=np.zeros(5) if corners else None,
        )
        for k in range(2)
    ]
    return pairs, np.asarray(np.linalg.inv(X[0]) @ X[1])


def solved(pairs: list[PosePairs]) -> tuple[SensorsTogether, SensorsTogether]:
    """Solve together, and each by itself: in the form of the former, without covariance between the sensors."""
    config = HandEyeConfig(folds=0)
    results = [solve_problem(full_problem(p.F, p.G, p.H), config=config) for p in pairs]
    both = solve_together([SensorPairs(name=p.source, pairs=p, result=r) for p, r in zip(pairs, results, strict=True)])
    X = np.array([np.asarray(r.X.GetAsMatrix4()) for r in results])
    apart = block_diag(*[r.covariance["X"] for r in results], np.zeros((6, 6)))
    return both, replace(both, X=X, covariance=apart)


def errors(found: SensorsTogether, truth: Array) -> tuple[float, float, float]:
    """Error of X_C1C2 in mm and degrees, and its squared Mahalanobis distance."""
    X, S = found.between(0, 1)
    d = difference(X, truth)
    return (
        1e3 * float(np.linalg.norm(d[3:])),
        float(np.degrees(np.linalg.norm(d[:3]))),
        float(d @ np.linalg.solve(S, d)),
    )


def row(name: str, of: list[list[tuple[float, float, float]]]) -> tuple[str, ...]:
    """One line of the table: medians together and apart, in how many sets the former is less, and the region."""
    both, apart = (np.array(part) for part in zip(*of, strict=True))
    ahead = int((both[:, 0] < apart[:, 0]).sum())
    return (
        name,
        str(len(both)),
        f"{np.median(both[:, 0]):.2f}, {np.median(apart[:, 0]):.2f}",
        f"{np.median(both[:, 1]):.3f}, {np.median(apart[:, 1]):.3f}",
        f"{100 * ahead / len(both):.0f} %",
        f"{100 * np.mean(both[:, 2] < REGION):.0f} %, {100 * np.mean(apart[:, 2] < REGION):.0f} %",
    )


@figure("hand-eye-several", "two cameras solved together or each by itself: the pose between them against the truth")
def hand_eye_several(run: Run) -> None:
    """Made worlds with a wrong arm; and drawn shared poses of a public cell (--data), whose camera matrix is off."""
    rows = []
    for name, corners in (("poses, arm of 0.3 mm", False), ("corners, principal point off", True)):
        sets = [made(seed, corners=corners) for seed in run.seeds(4, 100)]
        rows.append(row(name, [[errors(f, X) for f in solved(pairs)] for pairs, X in sets]))
    if run.data is not None and (run.data / "multi_camera_workcell_camera1").is_dir():
        pairs, truth = public_cell(run.data)
        for n in (8, 15, 25):
            of = []
            for seed in run.seeds(3, 40):
                try:
                    of.append([errors(f, truth) for f in solved(drawn(pairs, n, seed))])
                except WeldcalError as problem:
                    run.say(f"{n} poses, draw {seed}: {problem}")
            rows.append(row(f"public cell, {n} shared poses", of))
        rows.append(row("public cell, all poses", [[errors(f, truth) for f in solved(pairs)]]))
    run.table(
        "",
        ("sets", "number", "mm, together and apart", "deg", "together nearer", "inside 95 %, together and apart"),
        rows,
    )


def public_cell(folder: Path) -> tuple[list[PosePairs], Array]:
    """Pairs of the two cameras, and the published X_C1C2 (4, 4)."""
    names = [f"multi_camera_workcell_camera{k}" for k in (1, 2)]
    pairs = [replace(read_pairs(folder / name), source=name) for name in names]
    X = [p.X_true for p in pairs]
    assert X[0] is not None
    assert X[1] is not None
    return pairs, np.asarray(np.linalg.inv(X[0]) @ X[1])


def drawn(pairs: list[PosePairs], n: int, seed: int) -> list[PosePairs]:
    """Some of the poses that both cameras measured."""
    a, b = (p.robot for p in pairs)
    shared = np.argwhere(np.abs(a[:, None] - b[None]).max(axis=(2, 3)) < 1e-5)
    rows = shared[np.random.default_rng(seed).choice(len(shared), n, replace=False)]
    out = []
    for p, mine in zip(pairs, rows.T, strict=True):
        assert p.img is not None
        out.append(replace(p, robot=p.robot[mine], camera=p.camera[mine], img=p.img[mine]))
    return out
