"""Chooses the next hand-eye pose: the reachable, visible one that reduces the uncertainty at the work point most."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.calibration.geometry.se3 import as_transform, exp_rotation, inverse, log_rotation, skew
from weldcal.calibration.hand_eye.mountings import Mounting
from weldcal.calibration.hand_eye.problem import Loss, Noise, Problem, Scaled, State, linearise
from weldcal.calibration.hand_eye.solve import HandEyeResult
from weldcal.models.arms.inverse import inverse_kinematics
from weldcal.models.arms.kinematics import Chain
from weldcal.models.arrays import Array
from weldcal.models.scanners import ScannerPreset

Flags = NDArray[np.bool_]

_MARGIN = 0.85  # of the half picture: a board is more than its origin
_WIDER = 1.15  # than what was seen: as far as a sentence may go without knowing the camera
_STEEPEST_RAD = float(np.radians(60.0))


@dataclass(frozen=True)
class VisibleVolume:
    """Visible volume.

    ``tan_x``, ``tan_y``: half field of view. ``near``, ``far``: along the optical axis, in the unit of the data.
    ``tilt_rad``: largest angle between the target's normal and the line of sight. ``source``: its description for
    messages.
    """

    tan_x: float
    tan_y: float
    near: float
    far: float
    tilt_rad: float
    source: str

    def sees(self, G: Array) -> Flags:
        """Which targets (n, 4, 4) in the camera are visible."""
        p = G[:, :3, 3]
        z = np.maximum(p[:, 2], 1e-12)
        inside = (np.abs(p[:, 0]) <= self.tan_x * z) & (np.abs(p[:, 1]) <= self.tan_y * z)
        return np.asarray(inside & (p[:, 2] >= self.near) & (p[:, 2] <= self.far) & (tilt(G) <= self.tilt_rad))


def tilt(G: Array) -> Array:
    """Return angles (n,) rad between the z axis of targets (n, 4, 4), of either sign, and the line of sight."""
    p = G[:, :3, 3]
    ray = p / np.maximum(np.linalg.norm(p, axis=1), 1e-12)[:, None]
    return np.asarray(np.arccos(np.clip(np.abs((ray * G[:, :3, 2]).sum(axis=1)), 0.0, 1.0)))


def view_of(seen: Array, K: Array | None = None, scanner: ScannerPreset | None = None) -> VisibleVolume:
    """Return what a scanner preset sees, else a camera matrix ``K``, else what was ``seen`` (n, 4, 4) so far.

    The picture of a camera matrix is centred on its principal point, and its distances are those seen. What was seen is
    taken a little wider.
    """
    steep = max(_STEEPEST_RAD, float(np.quantile(tilt(seen), 0.9)))
    if scanner is not None:
        wide = [min(c, size - 1 - c) / f for c, size, f in _axes(scanner)]
        return VisibleVolume(
            _MARGIN * wide[0],
            _MARGIN * wide[1],
            scanner.near_m,
            scanner.far_m,
            steep,
            f"the field of view of {scanner.name}",
        )
    z = seen[:, 2, 3]
    near, far = float(z.min()) / _WIDER, float(z.max()) * _WIDER
    if K is not None:
        tan = _MARGIN * K[0, 2] / K[0, 0], _MARGIN * K[1, 2] / K[1, 1]
        return VisibleVolume(
            float(tan[0]), float(tan[1]), near, far, steep, "the camera's picture and the distances so far"
        )
    across = np.abs(seen[:, :2, 3]) / np.maximum(z, 1e-12)[:, None]
    x, y = (_WIDER * float(across[:, k].max()) for k in range(2))
    return VisibleVolume(x, y, near, far, steep, "where the target has been seen so far")


def _axes(scanner: ScannerPreset) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return (scanner.cx, float(scanner.width), scanner.fx), (scanner.cy, float(scanner.height), scanner.fy)


_TURNS_RAD = np.radians([20.0, 40.0, 60.0])
_PRIOR_SHARE = 10.0  # what is believed of an open direction: ten radians or extents
_SAMPLES = 15
_TRIED = 40  # candidates, best first, whose joint angles are sought
_ROOM = 0.1  # of their spread: how far from the places so far a pose may lie where no robot is named
_MOST = 0.8  # of the poses so far that a robot must reach, to be the one that took them


@dataclass(frozen=True, kw_only=True)
class NextPose:
    """A pose to add, and the predicted sigma (3-D) at the work point before and after.

    ``X_BF`` is the first robot's pose, or None where the mounting leaves it open; ``q`` (rad) its joint angles where a
    robot was named. The target, at X_CM, is turned from a taken sample, ``like``; ``checked`` says what was.
    """

    X_BF: RigidTransform | None
    X_CM: RigidTransform
    like: int
    turn_deg: float
    axis_C: Array
    sigma_before: float
    sigma_after: float
    q: Array | None = None
    checked: str = ""

    def sentence(self) -> str:
        """Instruction for the operator; its first sentence names the pose."""
        a = "(" + ", ".join(f"{v + 0.0:+.2f}" for v in self.axis_C) + ")"
        before = "open" if not np.isfinite(self.sigma_before) else f"{1e3 * self.sigma_before:.2f} mm"
        gain = f"the uncertainty at the work point falls from {before} to {1e3 * self.sigma_after:.2f} mm"
        like = (
            f"like sample {self.like}, with the target seen turned by {self.turn_deg:.0f} deg about {a} of the camera"
        )
        said = f"Add a pose {like}: {gain}."
        if self.X_BF is not None:
            p, w = 1e3 * self.X_BF.translation(), log_rotation(self.X_BF.rotation().matrix()[None])[0]
            said = (
                f"Add the pose with the flange at ({p[0]:.0f}, {p[1]:.0f}, {p[2]:.0f}) mm, rotation vector "
                f"({w[0]:.3f}, {w[1]:.3f}, {w[2]:.3f}) rad: {gain}. It is {like}."
            )
        if self.q is not None:
            said += " Joints (" + ", ".join(f"{v:.1f}" for v in np.degrees(self.q)) + ") deg."
        return f"{said} {self.checked}".rstrip()


def next_pose(
    problem: Problem,
    result: HandEyeResult,
    mounting: Mounting,
    known: State,
    *,
    arm: Chain | None = None,
    view: VisibleVolume | None = None,
) -> NextPose | None:
    """Choose the most informative of poses like the samples.

    The target is turned by 20, 40 or 60 degrees, and seen there or elsewhere.

    Visible: inside ``view``, by default where the target has been seen so far. Reachable: ``arm`` has joint angles for
    it within its limits. Where none is named, or where it does not even reach the poses so far (another base or tool
    frame), the flange stays about where it has been, and ``checked`` says so. The work point is the mean place of the
    target before the camera. None where no candidate is left. For a scanner that watches a flange, pose_planning plans
    with the arm's bodies too.
    """
    state = _state(result, known, problem)
    # one sample of each observation: repeats add nothing
    kept = np.nonzero(result.inliers)[0]
    taken = kept[np.unique(result.observation[kept], return_index=True)[1]]
    used = problem.pick(taken)
    noise = Noise(
        max(float(np.nan_to_num(result.sigma_rotation_rad)) ** 2, 1e-12), max(result.sigma_translation**2, 1e-14)
    )
    now = Scaled(used, linearise(used, state, np.zeros(3)), noise, Loss.SQUARES)
    scale = np.tile(np.repeat([1.0, result.extent], 3), problem.size // 6)
    information = now.Gw + now.Gd + np.diag(1.0 / (_PRIOR_SHARE * scale) ** 2)
    work_C = used.G[:, :3, 3].mean(axis=0)
    seen = used.G.copy()
    seen[:, :3, :3] = [_seen_rotation(used, state, i) for i in range(len(used))]
    view = view or view_of(seen)
    like, angle, axis, G = _candidates(seen, view)
    if not len(like):
        return None
    one = Problem(
        F=(state[1] @ used.H[like] @ state[2]) @ inverse(state[0] @ G),
        G=G,
        H=used.H[like],
        full=used.full[like],
        normal=used.normal[like],
        covariance=None,
        free=problem.free,
    )
    lin = linearise(one, state, np.zeros(3))
    more = np.swapaxes(lin.Jw, 1, 2) @ lin.Jw / noise.rotation + np.swapaxes(lin.Jd, 1, 2) @ lin.Jd / noise.translation
    after = _sigmas(information + more, state, work_C)
    before = float(_sigmas(information[None], state, work_C)[0])
    robot = _robot_poses(mounting, one.F)
    reach, checked, tries = _reach(mounting, used.F, robot, arm)
    found = None
    for k in np.argsort(after, kind="stable")[:tries] if tries else np.argsort(after, kind="stable"):
        ok, q = reach(int(k))
        if ok:
            found = int(k), q
            break
    if found is None:
        return None
    k, q = found
    return NextPose(
        X_BF=None if robot is None else as_transform(robot[k]),
        X_CM=as_transform(G[k]),
        like=int(taken[like[k]]),
        turn_deg=float(np.degrees(angle[k])),
        axis_C=axis[k],
        sigma_before=before if before < result.extent else float("inf"),
        sigma_after=float(after[k]),
        q=q,
        checked=f"{checked} Seen within {view.source}.",
    )


def _candidates(seen: Array, view: VisibleVolume) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Sample (k,), turn (k,) rad, its axis (k, 3), and the target in the camera (k, 4, 4) of all that is visible."""
    samples = np.arange(0, len(seen), max(1, len(seen) // _SAMPLES))
    axes = np.vstack([np.eye(3), -np.eye(3)])
    depth = float(np.clip(np.median(seen[:, 2, 3]), view.near, view.far))
    side = 0.7 * np.array([[x * view.tan_x, y * view.tan_y, 1.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)]) * depth
    like, turn, axis, place = (
        a.reshape(-1)
        for a in np.meshgrid(samples, np.arange(len(_TURNS_RAD)), np.arange(6), np.arange(1 + len(side)), indexing="ij")
    )
    G = seen[like].copy()
    G[:, :3, :3] = exp_rotation(_TURNS_RAD[turn][:, None] * axes[axis]) @ G[:, :3, :3]
    elsewhere = place > 0
    G[elsewhere, :3, 3] = side[place[elsewhere] - 1]
    ok = view.sees(G)
    return like[ok], _TURNS_RAD[turn[ok]], axes[axis[ok]], G[ok]


def _reach(
    mounting: Mounting, F: Array, robot: Array | None, arm: Chain | None
) -> tuple[Callable[[int], tuple[bool, Array | None]], str, int]:
    """Return whether a candidate can be reached, with joint angles; in words; and how many to try (0: all)."""
    taken = _robot_poses(mounting, F)
    if robot is None or taken is None:
        return lambda _: (True, None), "Reach not checked: this mounting leaves the arm's pose open.", 0
    why = "Reach not checked beyond staying near the poses so far: name the robot with --robot."
    if arm is not None:

        def solve(X: Array) -> Array | None:
            found = inverse_kinematics(arm, as_transform(X))
            return found[int(np.argmin(np.abs(found).max(axis=1)))] if len(found) else None

        some = taken[:: max(1, len(taken) // 8)]
        if float(np.mean([solve(X) is not None for X in some])) >= _MOST:

            def reached(k: int) -> tuple[bool, Array | None]:
                q = solve(robot[k])
                return q is not None, q

            return reached, f"Within reach and limits of {arm.name}.", _TRIED
        why = f"Reach not checked: {arm.name} does not reach the poses so far (another base or tool frame?)."
    p = taken[:, :3, 3]
    room = _ROOM * float(np.ptp(p, axis=0).max())
    low, high = p.min(axis=0) - room, p.max(axis=0) + room

    def near(k: int) -> tuple[bool, Array | None]:
        return bool(((robot[k, :3, 3] >= low) & (robot[k, :3, 3] <= high)).all()), None

    return near, why, 0


def _seen_rotation(problem: Problem, state: State, i: int) -> Array:
    if problem.full[i]:
        return np.asarray(problem.G[i, :3, :3])
    seen = inverse(problem.F[i] @ state[0]) @ (state[1] @ problem.H[i] @ state[2])
    return np.asarray(seen[:3, :3])


def _robot_poses(mounting: Mounting, F: Array) -> Array | None:
    if mounting.name in ("eye_in_hand", "co_manipulation"):
        return F
    return inverse(F) if mounting.name == "eye_on_base" else None


def _state(result: HandEyeResult, known: State, problem: Problem) -> State:
    out = [np.asarray(result.poses[k].GetAsMatrix4()) if k in result.poses else known[i] for i, k in enumerate("XYZ")]
    if problem.tied:
        out[1] = out[0]
    return out[0], out[1], out[2]


def _sigmas(information: Array, state: State, work_C: Array) -> Array:
    """Predicted standard deviations (k,) (3-D) of a point at the work point, in the parent frame of the camera."""
    s = 1.0 / np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    C = np.linalg.inv(information * s[:, :, None] * s[:, None, :]) * s[:, :, None] * s[:, None, :]
    J = np.hstack([-skew(state[0][:3, :3] @ work_C), np.eye(3)])
    return np.asarray(np.sqrt(np.maximum(np.einsum("ij,njk,ik->n", J, C[:, :6, :6], J), 0.0)))
