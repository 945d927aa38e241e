"""Clearance of the arm's capsules from table, itself, line of sight, and the surfaces that surround the cell."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from weldcal.models.arms.kinematics import Chain, link_frames
from weldcal.models.arms.urdf import Capsule
from weldcal.models.arrays import Array
from weldcal.models.compiled import compiled
from weldcal.models.mesh import TriMesh

TOOL = 7  # bodies of the tool: on the flange, one link further than wrist 3
STANDING = (0, 1)  # links: base and shoulder stand on the table by design
_UP = np.array([0.0, 0.0, 1.0])
_SAMPLES = np.linspace(0.0, 1.0, 5)

# of the points along a capsule's axis, in its radii: a gap is too large by a thirtieth of the radius at most
_SPACING = 0.5
_STEP_RAD = 0.05  # a choice: 5 cm of the flange at a reach of 1 m; a step of half the size takes twice the time


@dataclass(frozen=True, eq=False)
class LinkCapsule:
    """A capsule and the link that carries it (TOOL for the tool, whose frame is the flange)."""

    link: int
    frame: int
    p_start: Array
    p_end: Array
    radius: float


def arm_bodies(arm: Chain, tool: Sequence[Capsule] = ()) -> list[LinkCapsule]:
    """Capsules of the arm's links and of a tool given in the flange frame."""
    from weldcal.models.arms.shape import arm_capsules  # only here: a job that plans nothing needs no shapes

    bodies = [LinkCapsule(c.link_index, c.link_index, c.p_start, c.p_end, c.radius) for c in arm_capsules(arm)]
    return bodies + [LinkCapsule(arm.n + 1, arm.n, c.p_start, c.p_end, c.radius) for c in tool]


def body_ends(body: LinkCapsule, frames: list[RigidTransform]) -> tuple[Array, Array]:
    """Both ends of a body's axis (3,) in B, m, with the arm's links at `frames`."""
    X = frames[body.frame]
    return np.asarray(X @ body.p_start), np.asarray(X @ body.p_end)


def lowest_point(bodies: list[LinkCapsule], frames: list[RigidTransform], up: Array = _UP) -> float:
    """Lowest height (m over B's origin, along ``up`` (3,), a unit vector in B) of all bodies that move."""
    moving = [b for b in bodies if b.link not in STANDING]
    return min(min(float(e @ up) for e in body_ends(b, frames)) - b.radius for b in moving)


def self_distance(bodies: list[LinkCapsule], frames: list[RigidTransform]) -> float:
    """Smallest gap (m) between bodies at least three links apart (nearer ones share a joint housing).

    Segments are sampled.
    """
    ends = np.array([body_ends(b, frames) for b in bodies])
    links, radii = np.array([b.link for b in bodies]), np.array([float(b.radius) for b in bodies])
    return float(_smallest_gap(ends, links, radii, _SAMPLES))


@compiled()
def _smallest_gap(ends: Array, links: NDArray[np.int64], radii: Array, samples: Array) -> float:
    """Smallest gap between bodies at least three links apart.

    ``ends`` (n, 2, 3) m, ``samples`` (s,) where their axes are sampled.
    """
    n, m = len(ends), len(samples)
    points = np.empty((n, m, 3))
    for i in range(n):
        for u in range(m):
            for k in range(3):  # not as rows: Numba takes four times as long to compile that
                points[i, u, k] = ends[i, 0, k] + samples[u] * (ends[i, 1, k] - ends[i, 0, k])
    gap = np.inf
    for i in range(n):
        for j in range(i + 1, n):
            if abs(links[i] - links[j]) < 3:
                continue
            nearest = np.inf
            for u in range(m):
                for v in range(m):
                    square = 0.0
                    for k in range(3):
                        square += (points[i, u, k] - points[j, v, k]) ** 2
                    nearest = min(nearest, square)
            gap = min(gap, np.sqrt(nearest) - radii[i] - radii[j])
    return gap


def path_clearance(
    arm: Chain, bodies: list[LinkCapsule], q_a: Array, q_b: Array, step_rad: float = 0.1
) -> tuple[float, float]:
    """Return the lowest height (m) of the moving bodies and the smallest gap (m) on a path straight in joint space.

    Heights are over B's origin, along the arm's ``up``; gaps are between bodies.

    ``q_a``, ``q_b`` (6,) rad; the path is sampled so that no joint turns by more than ``step_rad`` between samples.
    """
    n = int(np.ceil(float(np.abs(q_b - q_a).max()) / step_rad)) + 1
    placed = [link_frames(arm, q_a + u * (q_b - q_a)) for u in np.linspace(0.0, 1.0, max(n, 2))]
    return min(lowest_point(bodies, f, arm.up) for f in placed), min(self_distance(bodies, f) for f in placed)


def occludes(
    bodies: list[LinkCapsule], frames: list[RigidTransform], eye: Array, targets: Array, margin_m: float = 0.0
) -> tuple[bool, float]:
    """Test whether a body hides any of the targets (N, 3) from the eye (3,).

    Also returns the smallest gap (m) from a body to the eye.

    The place of the eye is known to `margin_m` only: no line of sight from anywhere so near may be blocked.
    A body that holds or touches a target carries it and does not hide it: the face looks away from its own body.
    """
    hidden, gap = False, np.inf
    # copies: the code is compiled anew for each kind of view
    eye, targets = np.array(eye, dtype=float), np.array(targets, dtype=float, order="C")
    for body in bodies:
        start, end = body_ends(body, frames)
        gap = min(gap, float(_point_segment(eye[None], start, end)[0]) - body.radius)
        if bool((_point_segment(targets, start, end) < body.radius + 0.005).any()):
            continue
        if not hidden:
            # an eye that stands elsewhere by the margin moves its line of sight by less and less towards the target
            hidden = _in_sight(eye, targets, start, end, float(body.radius), float(margin_m))
    return hidden, gap


def _point_segment(points: Array, start: Array, end: Array) -> Array:
    d = end - start
    length = float(d @ d)
    s = np.clip((points - start) @ d / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - start - s[:, None] * d, axis=1))


@compiled()
def _in_sight(eye: Array, targets: Array, b0: Array, b1: Array, radius: float, margin: float) -> bool:
    """Return whether the segment b0 b1 with a radius lies in a line of sight from the eye to a target.

    Smallest distance of two segments and where on the first (0..1): closest points of the lines, clamped in turn.
    """
    for i in range(len(targets)):
        u, v, w = targets[i] - eye, b1 - b0, eye - b0
        a, b, c, d, e = (u * u).sum(), (u * v).sum(), (v * v).sum(), (u * w).sum(), (v * w).sum()
        det = a * c - b * b
        s = min(max((b * e - c * d) / det, 0.0), 1.0) if det > 1e-12 * max(a * c, 1e-30) else 0.0
        t = min(max((b * s + e) / c, 0.0), 1.0) if c > 0.0 else 0.0
        s = min(max((b * t - d) / a, 0.0), 1.0) if a > 0.0 else 0.0
        if np.sqrt(((w + s * u - t * v) ** 2).sum()) < radius + margin * (1.0 - s):
            return True
    return False


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A thing that the arm must not touch: its surface in B, m, and how far the arm keeps away from it, m."""

    name: str
    mesh: TriMesh
    margin_m: float = 0.0

    @cached_property
    def _closed(self) -> bool:
        return self.mesh.watertight()

    def distance(self, points: Array) -> Array:
        """Distance (N,) m of points (N, 3); inside a closed surface it is negative."""
        query = np.ascontiguousarray(points, dtype=np.float32)
        if self._closed:
            return np.asarray(self.mesh.scene.compute_signed_distance(query).numpy(), dtype=float)
        return np.asarray(self.mesh.scene.compute_distance(query).numpy(), dtype=float)

    def blocks(self, eye: Array, targets: Array) -> bool:
        """Return whether a line of sight from the eye (3,) to one of the targets (N, 3) meets the surface."""
        rays = np.hstack([np.broadcast_to(eye, targets.shape), targets - eye]).astype(np.float32)
        return bool((self.mesh.scene.cast_rays(np.ascontiguousarray(rays))["t_hit"].numpy() < 1.0).any())


@dataclass(frozen=True, eq=False)
class Surroundings:
    """All obstacles of a cell."""

    obstacles: tuple[Obstacle, ...] = ()

    def touched(self, bodies: Sequence[LinkCapsule], frames: list[RigidTransform]) -> str:
        """Name of the first obstacle nearer to a moving body than its margin; empty where all are free."""
        points, radii = _sampled(bodies, frames)
        for obstacle in self.obstacles:
            if float((obstacle.distance(points) - radii).min()) < obstacle.margin_m:
                return obstacle.name
        return ""

    def touched_on_path(self, arm: Chain, bodies: Sequence[LinkCapsule], q_a: Array, q_b: Array) -> str:
        """As `touched`, on a path straight in joint space from q_a to q_b (6,) rad."""
        if not self.obstacles:
            return ""
        n = int(np.ceil(float(np.abs(q_b - q_a).max()) / _STEP_RAD)) + 1
        names = (
            self.touched(bodies, link_frames(arm, q_a + u * (q_b - q_a))) for u in np.linspace(0.0, 1.0, max(n, 2))
        )
        return next((name for name in names if name), "")

    def blocks(self, eye: Array, targets: Array) -> str:
        """Name of the first obstacle between the eye (3,) and one of the targets (N, 3); empty where there is none."""
        return next((o.name for o in self.obstacles if o.blocks(eye, targets)), "")


def _sampled(bodies: Sequence[LinkCapsule], frames: list[RigidTransform]) -> tuple[Array, Array]:
    """Points (N, 3) along the axes of the bodies that move, and the radius (N,) at each, m."""
    points, radii = [], []
    for body in bodies:
        if body.link in STANDING:
            continue
        start, end = body_ends(body, frames)
        n = int(np.ceil(float(np.linalg.norm(end - start)) / (_SPACING * body.radius))) + 1
        points.append(np.linspace(start, end, max(n, 2)))
        radii.append(np.full(max(n, 2), body.radius))
    return np.vstack(points), np.concatenate(radii)
