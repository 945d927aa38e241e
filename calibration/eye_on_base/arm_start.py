"""Estimate the scanner's approximate pose from the visible arm.

Its capsules at the recorded joints against one scan or more.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from weldcal.calibration.data.clouds import CloudError
from weldcal.calibration.data.dataset import Dataset, joint_angles
from weldcal.calibration.errors import DatasetError, FlangeNotFound, InconsistentPoses
from weldcal.calibration.eye_on_base.observations import FlangeObservations, fit_flanges
from weldcal.calibration.flange.face import plane_axes
from weldcal.calibration.flange.fit import FlangeGuess
from weldcal.calibration.geometry.se3 import angle_of, as_transform, exp_rotation, frames_along, pose
from weldcal.models.arms.chain import known_chains, load_chain
from weldcal.models.arms.inverse import inverse_kinematics, nearest_solution
from weldcal.models.arms.kinematics import ArmModel, Chain, chain_poses, link_frames
from weldcal.models.arms.shape import arm_capsules
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

_CELLS = 96  # across the field of view of all scans: one point of a scan in each cell
_MOVED_M = 0.03  # nearer than what other scans show behind it: the arm
_POINTS, _FEWEST = 300, 40  # of the arm in a scan, at most and at least
_VOXEL_M, _AROUND_M = 0.02, 0.12  # of the distance fields of an arm
_ANCHORS, _TURNS = (48, 90), 24  # points of a scan, of the arm's surface, and turns about their common normal
_ROUGH_M, _FINE_M = 0.045, 0.02  # how far a point may lie from a capsule: as hypothesis, and refined
_THROUGH_M = 0.06  # a surface that the scanner sees through by so much is not there
_FACING = 0.4  # cosine of the slant up to which a surface counts: a silhouette is not known so well
_MANY = 20_000  # poses
_KEPT, _REFINED = 250, 12  # hypotheses of a scan that all scans judge, and of these that are refined
_SCANS, _SCANS_BRANCHES = 8, 3  # that are compared with the arm, at most, and where its joint angles are not recorded
_DENSE = 400_000  # points of a scan that are looked at
_GUESS_M, _GUESS_RAD = 0.06, 0.35  # how far flange and start may lie apart
_JOINTS_M = 0.03  # between the stated flange and the one that the joints lead to: more is another arm, or a TCP
_FACE_M, _FACE_POINTS = 0.0025, 60  # half a face's thickness in a noisy scan, and the fewest points on it
_SAME_M, _SAME_RAD = 0.08, 0.25  # hypotheses that are the same
_EXPLAINED, _SEEN_THROUGH = 0.72, 0.12  # of an accepted start: the least share of points, the largest of surface
_MARGIN = 0.04  # and its lead over the next
# Capsules are thicker than the links inside them, so some of their surface is seen through (0.15 of a UR10e's,
# rendered): allowed where nothing else comes near.
_THROUGH_FAR_AHEAD, _FAR_AHEAD = 0.18, 0.3


@dataclass(frozen=True, eq=False)
class ArmShape:
    """Capsules of an arm in B at one scan: ends of the axes (k, 2, 3) m, radii (k,) m."""

    ends: Array
    radii: Array


@dataclass(frozen=True, eq=False)
class ArmStart:
    """Where the scanner seems to stand.

    ``explained``: share of the moving points on the arm. ``seen_through``: share of the arm's surface in view behind
    which the scanner measured. ``next_best``: the score of the best other place. ``score`` of this one.
    """

    X_BC: RigidTransform
    explained: float
    seen_through: float
    score: float
    next_best: float

    @property
    def accepted(self) -> bool:
        """Whether arm and scans agree well enough for a start, and nowhere else nearly as well."""
        lead = self.score - self.next_best
        through = _SEEN_THROUGH if lead < _FAR_AHEAD else _THROUGH_FAR_AHEAD
        return self.explained > _EXPLAINED and self.seen_through < through and lead > _MARGIN

    @property
    def sentence(self) -> str:
        """Where the arm puts the scanner, or that it does not."""
        if not self.accepted:
            return (
                "The visible arm does not show where the scanner stands either: scan more of the arm, or state"
                " scanner_guess in dataset.yaml."
            )
        x, y, z = self.X_BC.translation()
        return (
            f"The visible arm puts the scanner at about ({x:.2f}, {y:.2f}, {z:.2f}) m in the robot's base; turn the"
            " flange to it, nearer and with nothing between."
        )

    def agreement(self, X_BC: RigidTransform, p_B: Array) -> str:
        """Return a sentence on how well a calibration agrees with the arm at points (n, 3) m of the base.

        Raises:
            InconsistentPoses: it does not.
        """
        D = X_BC @ self.X_BC.inverse()
        off = max(float(np.linalg.norm(D @ p - p)) for p in p_B)
        turn = D.rotation().ToAngleAxis().angle()
        if off > _GUESS_M or turn > _GUESS_RAD:
            raise InconsistentPoses(
                f"Flange and visible arm put the scanner {1e3 * off:.0f} mm and {np.degrees(turn):.0f} degrees apart:"
                " scan the flange in more poses."
            )
        return f"The visible arm agrees with X_BC to {1e3 * off:.0f} mm and {np.degrees(turn):.1f} degrees."


def see_with_arm(
    data: Dataset, seen: FlangeObservations, standard: FlangeStandard, robot: str, *, seed: int = 0
) -> tuple[FlangeObservations, ArmStart | None]:
    """Return the flanges of scans, looked for where the visible arm puts them.

    As they were seen where the arm decides nothing.
    """
    start = start_from_arm(data, robot, seed=seed)
    if start is None or not start.accepted:
        return seen, start
    guesses, refused = {}, list(data.refused)
    for id in data.clouds:
        try:
            points = np.asarray(data.cloud(id), dtype=float).reshape(-1, 3)
            guesses[id] = face_guess(points, start.X_BC.InvertAndCompose(data.poses[id] @ data.X_FR), standard)
        except (CloudError, FlangeNotFound) as e:
            refused.append((id, e.reason))
    shown = replace(data, clouds={id: data.clouds[id] for id in guesses}, refused=tuple(refused))
    again = fit_flanges(shown, standard, guesses=guesses, seed=seed)
    return replace(again, data=replace(again.data or data, clouds=data.clouds, refused=data.refused)), start


def face_guess(points: Array, X_CR: RigidTransform, standard: FlangeStandard) -> FlangeGuess:
    """Locate the flange's face in a cloud (N, 3) m, to a millimetre or two, from a rough pose X_CR.

    The pose is right to some centimetres.

    The face is where most points lie on the ring, and fewest in the bore and just outside, on a plane
    along the expected axis. Plane and place are found in turns.

    Raises:
        FlangeNotFound: no face is there.
    """
    outer, bore = standard.outer_radius_m, standard.bore_radius_m
    center, normal = X_CR.translation(), X_CR.rotation().matrix()[:, 2]
    near = points[((points - center) ** 2).sum(axis=1) < (outer + 0.04) ** 2]  # NaN is not near
    for reach, step, levels in (
        (0.024, 0.002, np.arange(-0.03, 0.0301, 0.001)),
        *[(0.008, 0.001, np.arange(-4, 5) * 1e-3)] * 2,
    ):
        axes = np.column_stack(plane_axes(normal))
        height, xy = (near - center) @ normal, (near - center) @ axes
        shift = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1e-9, step)] * 2), axis=-1).reshape(-1, 2)
        best, move = 0.0, None
        for level in levels:
            on = xy[np.abs(height - level) < _FACE_M]
            few = on[:: max(1, len(on) // 300)]
            rho = np.hypot(few[:, 0] - shift[:, :1], few[:, 1] - shift[:, 1:])
            value = np.where(
                rho > outer + 0.012, 0.0, np.where(rho > outer, -1.0, np.where(rho > bore, 1.0, -0.7))
            ).sum(axis=1)
            k = int(np.argmax(value))
            if len(on) >= _FACE_POINTS and value[k] * len(on) / len(few) > best:
                best, move = float(value[k]) * len(on) / len(few), axes @ shift[k] + level * normal
        if move is None:
            raise FlangeNotFound("No face of the flange is where the visible arm puts it: it is turned away or hidden.")
        center = center + move
        face = near[(np.abs((near - center) @ normal) < _FACE_M) & (((near - center) ** 2).sum(axis=1) < outer**2)]
        plane = np.linalg.eigh(np.cov(face.T))[1][:, 0]
        normal = plane if float(plane @ normal) > 0.0 else -plane
        center = center + normal * float(normal @ (face.mean(axis=0) - center))
    return FlangeGuess(center, outer + 0.01, normal)


def start_from_arm(data: Dataset, robot: str, *, seed: int = 0) -> ArmStart | None:
    """X_BC to some centimetres from the scans of a dataset and its joint angles, q1 to qn of poses.csv; None without.

    Of Universal Robots' arms the joint angles follow from the poses, one branch after the other.
    """
    if robot not in known_chains():
        return None
    arm, ids = load_chain(robot), list(data.clouds)
    recorded = _recorded(data, arm, ids)
    most = _SCANS if recorded else _SCANS_BRANCHES
    clouds: dict[str, Array] = {}
    for id in ids[:: max(1, -(-len(ids) // most))]:
        try:
            clouds[id] = data.cloud(id)
        except CloudError:
            continue
    best: ArmStart | None = None
    for angles in [[recorded[id] for id in clouds]] if recorded else _branches(data, arm, list(clouds)):
        start = find_arm(list(clouds.values()), [arm_shape(arm, q) for q in angles], seed=seed)
        if start is not None and (best is None or start.score > best.score):
            best = start
        if best is not None and best.accepted:
            break
    return best


def _recorded(data: Dataset, arm: Chain, ids: list[str]) -> dict[str, Array]:
    """Recorded joint angles (n,) rad by scan.

    None where there are none, or where they lead elsewhere than the stated poses.
    """
    try:
        q = joint_angles(data, ids, arm.n)
    except DatasetError:
        return {}
    if q is None:
        return {}
    reached = chain_poses(arm, q)[:, :3, 3]
    off = max(float(np.linalg.norm(p - data.poses[id].translation())) for p, id in zip(reached, ids, strict=True))
    return dict(zip(ids, q, strict=True)) if off < _JOINTS_M else {}


def _branches(data: Dataset, arm: Chain, ids: list[str]) -> list[list[Array]]:
    """Follow the joint angles of the scans on each branch of the inverse kinematics of a Universal Robots arm."""
    poses = [data.poses[id] for id in ids]
    if not isinstance(arm, ArmModel) or not ids:
        return []
    out = []
    for first in inverse_kinematics(arm, poses[0]):
        row: list[Array | None] = [first]
        for X in poses[1:]:
            row.append(None if row[-1] is None else nearest_solution(arm, X, row[-1]))
        out.append([q for q in row if q is not None])
    return [row for row in out if len(row) == len(ids)]


def arm_shape(arm: Chain, q: Array) -> ArmShape:
    """Return the capsules of an arm at joint angles (n,) rad."""
    frames, bodies = link_frames(arm, q), arm_capsules(arm)
    ends = [[frames[c.link_index] @ p for p in (c.p_start, c.p_end)] for c in bodies]
    return ArmShape(np.array(ends), np.array([c.radius for c in bodies]))


def capsule_distance(points: Array, shape: ArmShape) -> tuple[Array, Array]:
    """Signed distance (N,) m of points (N, 3) from the union of an arm's capsules, and its gradient (N, 3)."""
    a, d = shape.ends[:, 0], shape.ends[:, 1] - shape.ends[:, 0]
    length = np.maximum((d * d).sum(axis=1), 1e-12)
    along = points @ d.T - (a * d).sum(axis=1)
    s = np.clip(along / length, 0.0, 1.0)
    square = (points * points).sum(axis=1)[:, None] - 2.0 * points @ a.T + (a * a).sum(axis=1)
    far = np.sqrt(np.maximum(square - s * (2.0 * along - s * length), 0.0)) - shape.radii
    row, nearest = np.arange(len(points)), np.argmin(far, axis=1)
    off = points - a[nearest] - s[row, nearest, None] * d[nearest]
    return far[row, nearest], off / np.maximum(np.linalg.norm(off, axis=1), 1e-9)[:, None]


def find_arm(clouds: Sequence[Array], shapes: Sequence[ArmShape], *, seed: int = 0) -> ArmStart | None:
    """X_BC to some centimetres from clouds, m in C, and the arm's capsules at each.

    None where too little of the arm is seen.

    What stands still in two clouds or more is no arm. Points of a scan with their normals are laid on points of the
    arm's surface, turned about the common normal. The scanner then must see the arm's surface wherever nothing hides
    it, and nothing behind it. The best hypotheses are refined by Gauss-Newton with a common allowance on the radii.
    """
    rng = np.random.default_rng(seed)
    views = _views(clouds, shapes, rng)
    able = [view for view in views if len(view.points) >= _FEWEST]
    if not able:
        return None
    X = np.vstack(
        [_likely(_hypotheses(v, rng), [v], _KEPT * 8) for v in sorted(able, key=lambda v: -len(v.points))[:3]]
    )
    X = _likely(X, able, _KEPT)
    score = np.mean([v.on_arm(X) - v.through(X) for v in able], axis=0)
    distinct: list[Array] = []
    for one in X[np.argsort(-score)]:
        if len(distinct) < _REFINED and not any(_same(one, other, able) for other in distinct):
            distinct.append(one)
    ended = [_refine(X, able) for X in distinct]
    judged = sorted(((*_verdict(X, able, allowance), X) for X, allowance in ended), key=lambda one: one[1] - one[0])
    explained, through, best = judged[0]
    others = [e - t for e, t, other in judged[1:] if not _same(best, other, able)]
    return ArmStart(as_transform(best), explained, through, explained - through, max(others, default=-1.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class _View:
    """A scan against the arm.

    Points (N, 3) m on what moved with their normals, depth image (h, w) m of the nearest points with the rays' origin
    and pitch, samples of the arm's surface (S, 3) m in B with normals, and its distance field with its origin.
    """

    points: Array
    normals: Array
    depth: Array
    origin: Array
    pitch: float
    samples: Array
    outward: Array
    field: NDArray[np.float32]
    corner: Array
    shape: ArmShape

    def near(self, X: Array, points: Array) -> Array:
        """Distances (n, N) m of points (N, 3) of C from the arm, the scanner at each of X (n, 4, 4)."""
        turn, shift = X[:, :3, :3] / _VOXEL_M, (X[:, :3, 3] - self.corner) / _VOXEL_M
        p = points.astype(np.float32) @ np.swapaxes(turn, 1, 2).astype(np.float32) + shift[:, None].astype(np.float32)
        top = np.array(self.field.shape, dtype=np.float32) - 1.0  # the outermost voxels are far from the arm
        cell = np.rint(np.clip(p, 0.0, top)).astype(np.intp)
        return np.asarray(self.field[cell[..., 0], cell[..., 1], cell[..., 2]])

    def through(self, X: Array) -> Array:
        """Share (n,) of the arm's surface in view behind which the scanner measured something."""
        R, p = X[:, :3, :3], X[:, :3, 3]
        local = (self.samples - p[:, None]) @ R  # (n, S, 3) in C
        facing = ((self.samples - p[:, None]) * self.outward).sum(axis=2) < -_FACING * np.linalg.norm(local, axis=2)
        z = np.maximum(local[..., 2], 1e-3)
        at = np.rint((local[..., :2] / z[..., None] - self.origin) / self.pitch).astype(np.intp)
        h, w = self.depth.shape
        inside = (at[..., 0] >= 0) & (at[..., 0] < w) & (at[..., 1] >= 0) & (at[..., 1] < h) & (local[..., 2] > 0.05)
        at[~inside] = 0
        measured = self.depth[at[..., 1], at[..., 0]]
        known = facing & inside & np.isfinite(measured)
        return np.asarray(
            (known & (measured > local[..., 2] + _THROUGH_M)).sum(axis=1) / np.maximum(known.sum(axis=1), 30)
        )

    def on_arm(self, X: Array) -> Array:
        """Share (n,) of the points that lie on the arm, roughly; of fewer points where there are many poses."""
        some = self.points[: 40 if len(X) > _MANY else 120]
        parts = [(np.abs(self.near(X[k : k + 2000], some)) < _ROUGH_M).mean(axis=1) for k in range(0, len(X), 2000)]
        return np.concatenate(parts)


def _views(clouds: Sequence[Array], shapes: Sequence[ArmShape], rng: np.random.Generator) -> list[_View]:
    flat = []
    for cloud in clouds:
        points = np.asarray(cloud, dtype=float).reshape(-1, 3)
        points = points[:: max(1, len(points) // _DENSE)]
        flat.append(points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0.05)])
    if not sum(map(len, flat)):
        return []
    rays = [p[:, :2] / p[:, 2:] for p in flat]
    some = np.vstack([r[:: max(1, len(r) // 5000)] for r in rays])
    low, high = np.quantile(some, 0.001, axis=0), np.quantile(some, 0.999, axis=0)
    pitch = float((high - low).max() / _CELLS)
    w, h = (int(n) + 1 for n in (high - low) / pitch)
    depth, first = np.full((len(flat), h, w), np.nan), np.full((len(flat), h, w), -1)
    for k, (points, ray) in enumerate(zip(flat, rays, strict=True)):
        at = np.rint((ray - low) / pitch).astype(np.intp)
        inside = np.flatnonzero((at[:, 0] >= 0) & (at[:, 0] < w) & (at[:, 1] >= 0) & (at[:, 1] < h))
        inside = inside[np.argsort(-points[inside, 2], kind="stable")]  # the nearest is written last
        depth[k, at[inside, 1], at[inside, 0]] = points[inside, 2]
        first[k, at[inside, 1], at[inside, 0]] = inside
    open_ = np.isnan(depth).sum(axis=0) >= max(1, len(flat) // 3)  # nothing behind
    with np.errstate(all="ignore"):
        behind = np.where(open_, np.inf, np.nanmax(np.where(np.isnan(depth), -np.inf, depth), axis=0))
    behind = minimum_filter(behind, 3)
    views = []
    for k, (points, shape) in enumerate(zip(flat, shapes, strict=True)):
        known = first[k] >= 0
        moved = known & (depth[k] < behind - _MOVED_M) if len(flat) > 1 else known
        mine = points[first[k][moved]]
        tree = points[first[k][known]]
        keep = rng.permutation(len(mine))[:_POINTS]
        views.append(
            _View(
                points=mine[keep],
                normals=_normals(mine[keep], tree),
                depth=depth[k],
                origin=low,
                pitch=pitch,
                shape=shape,
                **_arm_field(shape, rng),
            )
        )
    return views


def _normals(points: Array, cloud: Array) -> Array:
    """Normals (N, 3) towards the scanner of points (N, 3) from their neighbours in a cloud."""
    if len(points) == 0 or len(cloud) < 9:
        return np.zeros_like(points)
    near = cloud[np.asarray(cKDTree(cloud).query(points, k=9)[1])]
    d = near - near.mean(axis=1, keepdims=True)
    n = np.linalg.eigh(np.swapaxes(d, 1, 2) @ d)[1][:, :, 0]
    return np.asarray(np.where(((n * points).sum(axis=1) > 0.0)[:, None], -n, n))


def _arm_field(shape: ArmShape, rng: np.random.Generator) -> dict[str, Any]:
    """Samples of the surface of an arm, and its distances on a grid."""
    samples, outward = [], []
    for (a, b), r in zip(shape.ends, shape.radii, strict=True):
        n = 24 + int(40 * np.linalg.norm(b - a) / r)
        u = rng.normal(size=(n, 3))
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        d = b - a
        long = float(np.linalg.norm(d))
        s = rng.uniform(-r, long + r, n)
        if long > 1e-6:
            side = u - (u @ d)[:, None] * d / long**2
            side /= np.linalg.norm(side, axis=1, keepdims=True)
            over = np.clip(np.maximum(-s, s - long), 0.0, r)
            u = np.sqrt(1.0 - (over / r) ** 2)[:, None] * side + (np.sign(s) * over / r)[:, None] * d / long
        samples.append(a + np.clip(s, 0.0, long)[:, None] / max(long, 1e-9) * d + r * u)
        outward.append(u)
    p, n_ = np.vstack(samples), np.vstack(outward)
    free = capsule_distance(p, shape)[0] > -0.004
    corner = (shape.ends - shape.radii[:, None, None]).min(axis=(0, 1)) - _AROUND_M
    top = (shape.ends + shape.radii[:, None, None]).max(axis=(0, 1)) + _AROUND_M
    axes = [np.arange(c, t + _VOXEL_M, _VOXEL_M) for c, t in zip(corner, top, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = grid.reshape(-1, 3)
    far = np.concatenate([capsule_distance(flat[k : k + 20_000], shape)[0] for k in range(0, len(flat), 20_000)])
    return {
        "samples": p[free],
        "outward": n_[free],
        "field": far.reshape(grid.shape[:3]).astype(np.float32),
        "corner": corner,
    }


def _hypotheses(view: _View, rng: np.random.Generator) -> Array:
    """Poses X_BC (n, 4, 4) that lay a point of the scan on one of the arm's surface, normal on normal."""
    data = rng.permutation(len(view.points))[: _ANCHORS[0]]
    model = rng.permutation(len(view.samples))[: _ANCHORS[1]]
    frame_C, frame_B = frames_along(view.normals[data]), frames_along(view.outward[model])
    angle = np.arange(_TURNS) * 2.0 * np.pi / _TURNS
    turn = exp_rotation(angle[:, None] * [0.0, 0.0, 1.0])
    R = np.einsum("mij,tjk,dlk->mtdil", frame_B, turn, frame_C)
    p = view.samples[model][:, None, None] - np.einsum("mtdij,dj->mtdi", R, view.points[data])
    return pose(R, p).reshape(-1, 4, 4)


def _likely(X: Array, views: Sequence[_View], most: int) -> Array:
    """Of poses (n, 4, 4) those that lay most of the scans' points on the arm."""
    return X[np.argsort(-np.mean([view.on_arm(X) for view in views], axis=0), kind="stable")[:most]]


def _refine(X: Array, views: Sequence[_View]) -> tuple[Array, float]:
    """Return the pose that lays the scans' points best on the arm, and the allowance (m) on its radii."""
    X, allowance = X.copy(), 0.0
    for scale in np.geomspace(0.08, _FINE_M, 16):
        H, g = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 20.0]), np.zeros(7)
        g[6] = 20.0 * allowance
        for view in views:
            p = view.points @ X[:3, :3].T + X[:3, 3]
            d, n = capsule_distance(p, view.shape)
            r = d - allowance
            J = np.column_stack([np.cross(p - X[:3, 3], n), n, -np.ones(len(p))])
            w = np.square(np.clip(1.0 - np.square(r / (2.0 * scale)), 0.0, None))
            H += (J * w[:, None]).T @ J
            g += J.T @ (w * r)
        step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        step[:6] *= min(1.0, 0.2 / max(float(np.linalg.norm(step[:3])), 1e-12))
        X[:3, :3] = exp_rotation(step[:3]) @ X[:3, :3]
        X[:3, 3] += step[3:6]
        allowance += step[6]
    return X, float(allowance)


def _verdict(X: Array, views: Sequence[_View], allowance: float) -> tuple[float, float]:
    """Return mean shares over the scans: points on the arm, and arm surface that the scanner looks through."""
    on, through = [], []
    for view in views:
        d = capsule_distance(view.points @ X[:3, :3].T + X[:3, 3], view.shape)[0]
        on.append(float(np.mean(np.abs(d - allowance) < _FINE_M)))
        through.append(float(view.through(X[None])[0]))
    return float(np.mean(on)), float(np.mean(through))


def _same(X: Array, Y: Array, views: Sequence[_View]) -> bool:
    """Return whether two poses put the arm's points to about the same place."""
    turn = float(angle_of(X[:3, :3].T @ Y[:3, :3]))
    middle = np.mean([view.points.mean(axis=0) for view in views], axis=0)
    far = float(np.linalg.norm((X[:3, :3] - Y[:3, :3]) @ middle + X[:3, 3] - Y[:3, 3]))
    return turn < _SAME_RAD and far < _SAME_M
