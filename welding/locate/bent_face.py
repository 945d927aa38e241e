"""Finds faces bent over a cylinder in a cloud, fits them and unrolls them, so that methods for flat faces apply."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from weldcal.welding.locate.planes import Floats, into

LEAST_RADIUS_M, MOST_RADIUS_M = 0.100, 2.0
SEEDS, NEIGHBOURS, PAIRS = 2500, 40, 300
STRIPS, STRIP_AGREES = 8, math.radians(2.5)
LEAST_TURN = math.sin(math.radians(8.0))  # between two normals that are to span a cylinder
NORMALS_AGREE = math.cos(math.radians(9.0))
STEEPEST = math.cos(math.radians(65.0))
BAND_M = 0.003  # about a flat or bent face: above a scanner's noise and form error, below a plate's thickness


@dataclass(frozen=True, eq=False)
class BentFace:
    """A cylindrical face: frame Q is tangent to it at its origin, x around it, y along its axis, z out of the face; m.

    ``radius_m`` is negative where the axis lies above the face (a hollow one). Unrolled, a point has the coordinates
    (arc length around, along, height over the face). reach_m: how far from the origin the face was seen, around and
    along.
    """

    X_AQ: RigidTransform
    radius_m: float
    reach_m: tuple[float, float] = (math.inf, math.inf)

    def unrolled(self, p_A: Floats) -> Floats:
        """Points (N,3) of the cloud's frame A, unrolled."""
        return unrolled(into(self.X_AQ, p_A), self.radius_m)

    def rolled(self, u: Floats) -> Floats:
        """Unrolled points (N,3), back in A."""
        p = rolled(u, self.radius_m)
        return np.asarray(p @ self.X_AQ.rotation().matrix().T + self.X_AQ.translation())

    def up(self, u: Floats) -> Floats:
        """The face's unit normals (N,3) in A above unrolled points (N,3)."""
        angle = u[:, 0] / self.radius_m
        n = np.column_stack([np.sin(angle), np.zeros(len(u)), np.cos(angle)])
        return np.asarray(n @ self.X_AQ.rotation().matrix().T)

    def at(self, x: float, y: float, turn: float) -> RigidTransform:
        """The frame in A tangent to the face at an unrolled position, rotated by `turn` about its normal."""
        around = RotationMatrix.MakeYRotation(x / self.radius_m)
        p = rolled(np.array([[x, y, 0.0]]), self.radius_m)[0]
        return self.X_AQ @ RigidTransform(around @ RotationMatrix.MakeZRotation(turn), p)


def unrolled(p_Q: Floats, radius_m: float) -> Floats:
    """Unroll points (N,3) given in a frame tangent to the cylinder; the inverse of `rolled`."""
    r, side = abs(radius_m), math.copysign(1.0, radius_m)
    out, up = p_Q[:, 0], side * p_Q[:, 2] + r
    return np.column_stack([r * np.arctan2(out, up), p_Q[:, 1], side * (np.hypot(out, up) - r)])


def rolled(u: Floats, radius_m: float) -> Floats:
    """Roll unrolled points (N,3) back onto the cylinder."""
    r, side = abs(radius_m), math.copysign(1.0, radius_m)
    angle, far = u[:, 0] / r, r + side * u[:, 2]
    return np.column_stack([far * np.sin(angle), u[:, 1], side * (far * np.cos(angle) - r)])


def find_bent_faces(
    points: Floats,
    radii_m: tuple[float, float],
    rng: np.random.Generator,
    *,
    least_seeds: int = 60,
    most: int = 2,
    hollow: bool = False,
) -> list[BentFace]:
    """Find up to `most` faces with a bend radius in a range, largest first, in a cloud (N,3) m whose z is up.

    Two points and their normals span a cylinder; the one that most others agree with, in distance and in normal, is
    fitted.
    """
    at, normal = _normals(points, rng, min(map(abs, radii_m)))
    found: list[BentFace] = []
    for _ in range(most):
        if len(at) < least_seeds:
            break
        face = _spanned(at, normal, radii_m, rng, least_seeds, hollow)
        if face is None:
            break
        face = fit_bent_face(points, _centred(face, at, normal), radii_m)
        u = face.unrolled(at)
        on = (np.abs(u[:, 2]) < BAND_M) & _agrees(face, u, normal)
        if np.count_nonzero(on) >= least_seeds and radii_m[0] <= abs(face.radius_m) <= radii_m[1]:
            found.append(_centred(face, at, normal))
        rest = ~on & (np.abs(u[:, 2]) > 2.0 * BAND_M)
        at, normal = at[rest], normal[rest]
    return found


def _normals(points: Floats, rng: np.random.Generator, least_radius_m: float) -> tuple[Floats, Floats]:
    """Some points (M,3) and the normals (M,3) of the surface there, up.

    Those at edges are left out, but none for a bend of that radius or a wider one.
    """
    sample = points[rng.choice(len(points), size=min(len(points), 16 * SEEDS), replace=False)]
    seeds = sample[: min(SEEDS, len(sample))]
    near = sample[cKDTree(sample).query(seeds, k=min(NEIGHBOURS, len(sample)))[1]]
    off = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off) / near.shape[1])
    normal = vectors[:, :, 0] * np.where(vectors[:, 2:3, 0] < 0.0, -1.0, 1.0)
    rms = np.sqrt(np.maximum(values[:, 0], 0.0))
    # x^2 / 2r is the height over a bend; over a disc its standard deviation is var(x) / 2r
    bent = values[:, 2] / (2.0 * least_radius_m)
    flat = rms < np.hypot(3.0 * float(np.median(rms)), 1.5 * bent) + 1e-5
    keep = (normal[:, 2] > STEEPEST) & flat & (values[:, 1] > 0.1 * values[:, 2])
    return seeds[keep], normal[keep]


def _spanned(
    at: Floats, normal: Floats, radii_m: tuple[float, float], rng: np.random.Generator, least: int, hollow: bool
) -> BentFace | None:
    """The cylinder spanned by two points and their normals with the most inliers, or None."""
    first, second = rng.integers(len(at), size=(2, 20 * PAIRS))
    axis = np.cross(normal[first], normal[second])
    size = np.linalg.norm(axis, axis=1)
    gap = np.linalg.norm(at[first] - at[second], axis=1)
    good = np.flatnonzero((size > LEAST_TURN) & (gap < 0.3))[: 4 * PAIRS]
    best: tuple[int, BentFace] | None = None
    for i, j, a in zip(first[good], second[good], axis[good] / size[good, None], strict=True):
        if abs(a[2]) > 0.5:
            continue
        across, turn = at[i] - at[j], normal[i] - normal[j]
        across, turn = across - (across @ a) * a, turn - (turn @ a) * a
        radius = float(across @ turn) / float(turn @ turn)
        if not radii_m[0] <= abs(radius) <= radii_m[1] or (radius < 0.0 and not hollow):
            continue
        # Both points must lie on it, not only their normals meet.
        if np.linalg.norm(across - radius * turn) > 0.004:
            continue
        z = normal[i] - (normal[i] @ a) * a
        z /= np.linalg.norm(z)
        y = a if a[1] >= 0.0 else -a
        face = BentFace(RigidTransform(RotationMatrix(np.column_stack([np.cross(y, z), y, z])), at[i]), radius)
        u = face.unrolled(at)
        on = (np.abs(u[:, 2]) < BAND_M) & _agrees(face, u, normal)
        count = int(np.count_nonzero(on))
        if (best is None or count > best[0]) and count >= least and _turns(face, u[on, 0], normal[on]):
            best = (count, face)
    return None if best is None else best[1]


def _centred(face: BentFace, at: Floats, normal: Floats) -> BentFace:
    """The same face with its origin in the middle of its inliers among points (M,3), and their extent."""
    u = face.unrolled(at)
    on = u[(np.abs(u[:, 2]) < BAND_M) & _agrees(face, u, normal), :2]
    low, high = np.percentile(on, [1.0, 99.0], axis=0)
    middle, reach = 0.5 * (low + high), 0.5 * (high - low) + 0.005
    X = face.at(float(middle[0]), float(middle[1]), 0.0)
    return BentFace(X, face.radius_m, (float(reach[0]), float(reach[1])))


def _turns(face: BentFace, x: Floats, normal: Floats) -> bool:
    """Whether the normals (M,3) rotate with the arc length x (M,) as on that cylinder.

    Those of a tangent plane do not.
    """
    n = normal @ face.X_AQ.rotation().matrix()
    off = np.arctan2(n[:, 0], n[:, 2]) - x / face.radius_m
    # Strip by strip around it: a mixture of planes agrees on the whole, but in no strip.
    number = np.minimum((STRIPS * (x - x.min()) / max(float(np.ptp(x)), 1e-9)).astype(int), STRIPS - 1)
    middle = [abs(float(np.median(off[number == k]))) for k in range(STRIPS) if np.count_nonzero(number == k) >= 4]
    return len(middle) > STRIPS // 2 and sum(m < STRIP_AGREES for m in middle) >= 0.8 * len(middle)


def _agrees(face: BentFace, u: Floats, normal: Floats) -> npt.NDArray[np.bool_]:
    agree: Any = np.sum(face.up(u) * normal, axis=1) > NORMALS_AGREE
    return np.asarray(agree)


def fit_bent_face(
    points: Floats, face: BentFace, radii_m: tuple[float, float], gates_m: tuple[float, ...] = (0.004, 0.002, 0.001)
) -> BentFace:
    """Refine a cylinder by robust least squares on the points (N,3) near it, in axis, position and radius."""
    side = math.copysign(1.0, face.radius_m)
    low, high = (side * r for r in radii_m)
    low, high = min(low, high), max(low, high)
    reach = np.minimum(face.reach_m, 0.3)
    for gate in gates_m:
        p = into(face.X_AQ, points)
        u = unrolled(p, face.radius_m)
        on = p[(np.abs(u[:, 2]) < gate) & (np.abs(u[:, :2]) < reach).all(axis=1)]
        on = on[:: max(1, len(on) // 4000)]
        if len(on) < 100:
            return face

        def moved(v: Floats, X: RigidTransform = face.X_AQ) -> RigidTransform:
            return X @ RigidTransform(
                RotationMatrix.MakeXRotation(v[2]) @ RotationMatrix.MakeZRotation(v[3]), np.array([v[0], 0.0, v[1]])
            )

        def heights(v: Floats, on: Floats = on) -> Floats:
            return unrolled(into(moved(v, RigidTransform()), on), float(v[4]))[:, 2]

        start = np.array([0.0, 0.0, 0.0, 0.0, np.clip(face.radius_m, low, high)])
        bounds = (np.array([-0.05, -0.02, -0.2, -0.4, low - 1e-9]), np.array([0.05, 0.02, 0.2, 0.4, high + 1e-9]))
        fit = least_squares(
            heights, start, loss="soft_l1", f_scale=0.25 * gate, bounds=bounds, x_scale=[1e-2, 1e-3, 1e-2, 1e-2, 1e-1]
        )
        face = BentFace(moved(fit.x), float(fit.x[4]), face.reach_m)
    return face
