"""Sessions of one camera on one arm: whether the stated covariance of each holds the scatter between them."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.figures.harness import Run, figure
from weldcal.calibration.data.poses.listing import listing_of_array
from weldcal.calibration.geometry.se3 import difference, moved
from weldcal.calibration.hand_eye.opencv_methods import METHODS, opencv_solve
from weldcal.calibration.hand_eye.pictures.boards import parse_board
from weldcal.calibration.hand_eye.pictures.camera import camera_of
from weldcal.calibration.hand_eye.pictures.search import Picture
from weldcal.calibration.hand_eye.pictures.sets import picture_set
from weldcal.calibration.hand_eye.pictures.solution import solve_pictures
from weldcal.calibration.hand_eye.solve import fold_labels
from weldcal.calibration.recorded_hand_eye import problem_of_pairs, solve_pairs
from weldcal.models.arrays import Array

SESSIONS = Path("handeye/webcam_sessions/sessions.npz")
BOARD, SIZE = parse_board("chessboard:8x7:40"), (640, 480)
REGION = float(chi2.ppf(0.95, 6))


@dataclass(frozen=True, eq=False, kw_only=True)
class Session:
    """X with its covariance, fx with its own of hand-eye and of the camera alone, and OpenCV's poses by method.

    ``mean_px``: rms over the board's corners of the mean residual over all pictures, and what chance gives.
    ``ahead``: by how much the best method of OpenCV is better held out, the worse of degrees and millimetres.
    """

    name: str
    n: int
    X: Array
    covariance: Array
    fx: tuple[float, float]
    alone: tuple[float, float]
    mean_px: tuple[float, float]
    opencv: dict[str, Array]
    ahead: float


def sessions(path: Path) -> list[Session]:
    """Every session of a file, each solved by itself."""
    data = np.load(path)
    names = sorted({key.rpartition("_")[0] for key in data.files if key.endswith("_poses")})
    return [session(name, data[f"{name}_poses"], data[f"{name}_corners"].astype(float)) for name in names]


def session(name: str, poses: Array, corners: Array) -> Session:
    """One session; poses (n, 6) as x, y, z m and a rotation vector, corners (n, 56, 2) px."""
    robot = np.tile(np.eye(4), (len(poses), 1, 1))
    robot[:, :3, 3], robot[:, :3, :3] = poses[:, :3], Rotation.from_rotvec(poses[:, 3:]).as_matrix()
    pictures = [
        Picture(name=f"{k}.png", points=uv, size=SIZE, thumbnail=b"", why="" if np.isfinite(uv).all() else "No board.")
        for k, uv in enumerate(corners)
    ]
    data = picture_set(list(pictures), BOARD, listing_of_array("poses", robot), "eye_in_hand", name)
    result, pairs, found = solve_pictures(data, solve_pairs)
    b, alone = found.bundle, camera_of(list(pictures), BOARD)
    assert pairs.obj is not None
    assert pairs.img is not None
    rest = []
    for k in np.flatnonzero(result.inliers):
        C = pairs.camera[k]
        uv = cv2.projectPoints(pairs.obj, cv2.Rodrigues(C[:3, :3])[0], C[:3, 3], b.K, b.distortion)[0]
        rest.append(np.asarray(uv)[:, 0] - pairs.img[k])
    r = np.array(rest)
    mean = float(np.sqrt((r.mean(axis=0) ** 2).mean()))
    problem = problem_of_pairs(pairs)
    ours, held = result.held_out, {}
    for method in METHODS:
        e = [np.zeros(len(pairs.F)), np.zeros(len(pairs.F))]
        labels = fold_labels(len(pairs.F))
        for fold in range(5):
            out = labels == fold
            solved = opencv_solve(method, problem.F[~out], problem.G[~out])
            for i in np.flatnonzero(out):
                D = (
                    np.full(6, np.inf)
                    if solved is None
                    else difference(problem.F[i] @ solved[0] @ problem.G[i], solved[1])
                )
                e[0][i], e[1][i] = np.linalg.norm(D[:3]), np.linalg.norm(D[3:])
        held[method] = [float(np.sqrt(np.mean(v**2))) for v in e]
    best = np.min(list(held.values()), axis=0)
    own = np.array([np.radians(ours.rms_deg), ours.rms_translation])
    whole = {m: opencv_solve(m, problem.F, problem.G) for m in METHODS}
    return Session(
        name=name,
        n=len(b.off),
        X=b.X,
        covariance=b.covariance[:6, :6],
        fx=(float(b.K[0, 0]), float(b.camera_sigma[0])),
        alone=(float(alone.camera.K[0, 0]), float(alone.sigma[0])),
        mean_px=(mean, float(np.sqrt(r.var(axis=0, ddof=1).mean() / len(r)))),
        opencv={m: s[0] for m, s in whole.items() if s is not None},
        ahead=float((own / best).max() - 1.0),
    )


def scatter(X: Array, covariances: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distances (n,) of poses (n, 4, 4) from their weighted mean, and their differences (n, 6)."""
    mean, W = X[0], np.linalg.inv(covariances)
    for _ in range(10):
        d = np.array([difference(mean, x) for x in X])
        mean = moved(mean, np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, d)))
    d = np.array([difference(mean, x) for x in X])
    return np.einsum("ni,nij,nj->n", d, W, d), d


def nees(found: list[Session]) -> tuple[float, int]:
    """NEES per degree of freedom of X about the mean, and the number of sessions inside their 95 % region."""
    square, _ = scatter(np.array([s.X for s in found]), np.array([s.covariance for s in found]))
    return float(square.sum() / (6.0 * (len(found) - 1))), int((square < REGION).sum())


@figure(
    "hand-eye-sessions", "one camera on one arm in ten sessions (--data): scatter of X and fx beside what is stated"
)
def hand_eye_sessions(run: Run) -> None:
    """Solve each session by itself."""
    path = None if run.data is None else run.data / SESSIONS
    if path is None or not path.is_file():
        run.say(f"hand-eye-sessions: left out, for --data names no folder with {SESSIONS}.")
        return
    found = sessions(path)
    square, d = scatter(np.array([s.X for s in found]), np.array([s.covariance for s in found]))
    rows = [
        (
            s.name,
            f"{s.n}",
            ", ".join(f"{v:+.2f}" for v in 1e3 * e[3:]),
            f"{q:.1f}",
            f"{s.fx[0]:.2f} +- {s.fx[1]:.2f}",
            f"{s.alone[0]:.2f} +- {s.alone[1]:.2f}",
            f"{s.mean_px[0]:.4f} ({s.mean_px[1]:.4f})",
            f"{100 * s.ahead:+.1f} %",
        )
        for s, q, e in zip(found, square, d, strict=True)
    ]
    head = ("session", "pictures", "X from the mean, mm", "squared distance", "fx, px", "fx of the camera alone")
    run.table("", (*head, "corner mean, px (chance)", "OpenCV's best ahead"), rows)
    value, inside = nees(found)
    fx, stated = np.array([s.fx for s in found]).T
    run.say(f"NEES {value:.2f} per degree of freedom; {inside} of {len(found)} inside 95 %.")
    run.say(f"fx scatters {fx.std(ddof=1):.2f} px where {np.sqrt((stated**2).mean()):.2f} is stated.")
    spread = {m: np.array([s.opencv[m][:3, 3] for s in found if m in s.opencv]) for m in METHODS}
    of = {m: 1e3 * float(np.sqrt(v.var(axis=0, ddof=1).sum())) for m, v in spread.items() if len(v) == len(found)}
    ours = 1e3 * float(np.sqrt(np.array([s.X[:3, 3] for s in found]).var(axis=0, ddof=1).sum()))
    best = min(of, key=lambda m: of[m])
    run.say(f"X scatters {ours:.2f} mm; by OpenCV's steadiest method, {best}, on the same poses {of[best]:.2f} mm.")
