"""Clearance of the arm's capsules from the table, from itself and from the scanner's line of sight."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.arms.kinematics import ArmModel, link_frames
from weldcal.models.arms.urdf import Capsule, link_capsules
from weldcal.models.arrays import Array

TOOL = 7  # bodies of the tool: on the flange, one link further than wrist 3
STANDING = (0, 1)  # links: base and shoulder stand on the table by design
_UP = np.array([0.0, 0.0, 1.0])
_SAMPLES = np.linspace(0.0, 1.0, 5)


@dataclass(frozen=True, eq=False)
class Body:
    """A capsule and the link that carries it (TOOL for the tool, whose frame is the flange)."""

    link: int
    frame: int
    p_start: Array
    p_end: Array
    radius: float


def arm_bodies(arm: ArmModel, tool: Sequence[Capsule] = ()) -> list[Body]:
    """Capsules of the arm's links and of a tool given in the flange frame."""
    bodies = [Body(c.link_index, c.link_index, c.p_start, c.p_end, c.radius) for c in link_capsules(arm)]
    return bodies + [Body(TOOL, 6, c.p_start, c.p_end, c.radius) for c in tool]


def body_ends(body: Body, frames: list[RigidTransform]) -> tuple[Array, Array]:
    """Both ends of a body's axis (3,) in B, m, with the arm's links at `frames`."""
    X = frames[body.frame]
    return np.asarray(X @ body.p_start), np.asarray(X @ body.p_end)


def lowest_point(bodies: list[Body], frames: list[RigidTransform], up: Array = _UP) -> float:
    """Lowest height (m over B's origin, along ``up`` (3,), a unit vector in B) of all bodies that move."""
    moving = [b for b in bodies if b.link not in STANDING]
    return min(min(float(e @ up) for e in body_ends(b, frames)) - b.radius for b in moving)


def self_distance(bodies: list[Body], frames: list[RigidTransform]) -> float:
    """Smallest gap (m) between bodies at least three links apart (nearer ones share a joint housing); segments are
    sampled."""
    placed = [(b, np.linspace(*body_ends(b, frames), len(_SAMPLES))) for b in bodies]
    gap = np.inf
    for i, (a, pa) in enumerate(placed):
        for b, pb in placed[i + 1 :]:
            if abs(a.link - b.link) < 3:
                continue
            d = np.linalg.norm(pa[:, None] - pb[None], axis=2).min()
            gap = min(gap, float(d) - a.radius - b.radius)
    return float(gap)


def path_clearance(
    arm: ArmModel, bodies: list[Body], q_a: Array, q_b: Array, step_rad: float = 0.1
) -> tuple[float, float]:
    """Lowest height (m over B's origin, along the arm's ``up``) of the moving bodies and smallest gap (m) between bodies on a path straight in joint space.

    ``q_a``, ``q_b`` (6,) rad; the path is sampled so that no joint turns by more than ``step_rad`` between samples.
    """
    n = int(np.ceil(float(np.abs(q_b - q_a).max()) / step_rad)) + 1
    placed = [link_frames(arm, q_a + u * (q_b - q_a)) for u in np.linspace(0.0, 1.0, max(n, 2))]
    return min(lowest_point(bodies, f, arm.up) for f in placed), min(self_distance(bodies, f) for f in placed)


def occludes(
    bodies: list[Body], frames: list[RigidTransform], eye: Array, targets: Array, margin_m: float = 0.0
) -> tuple[bool, float]:
    """Whether a body hides any of the targets (N, 3) from the eye (3,), and the smallest gap (m) from a body to the
    eye.

    The place of the eye is known to `margin_m` only: no line of sight from anywhere so near may be blocked.
    A body that holds or touches a target carries it and does not hide it: the face looks away from its own body.
    """
    hidden, gap = False, np.inf
    for body in bodies:
        start, end = body_ends(body, frames)
        gap = min(gap, float(_point_segment(eye[None], start, end)[0]) - body.radius)
        if bool((_point_segment(targets, start, end) < body.radius + 0.005).any()):
            continue
        if not hidden:
            # an eye that stands elsewhere by the margin moves its line of sight by less and less towards the target
            near = [_segment_segment(eye, t, start, end) for t in targets]
            hidden = any(d < body.radius + margin_m * (1.0 - s) for d, s in near)
    return hidden, gap


def _point_segment(points: Array, start: Array, end: Array) -> Array:
    d = end - start
    length = float(d @ d)
    s = np.clip((points - start) @ d / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - start - s[:, None] * d, axis=1))


def _segment_segment(a0: Array, a1: Array, b0: Array, b1: Array) -> tuple[float, float]:
    """Smallest distance between two segments and where on the first (0..1): closest points of the lines, clamped in turn."""
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    a, b, c, d, e = float(u @ u), float(u @ v), float(v @ v), float(u @ w), float(v @ w)
    det = a * c - b * b
    s = float(np.clip((b * e - c * d) / det, 0.0, 1.0)) if det > 1e-12 * max(a * c, 1e-30) else 0.0
    t = float(np.clip((b * s + e) / c, 0.0, 1.0)) if c > 0.0 else 0.0
    s = float(np.clip((b * t - d) / a, 0.0, 1.0)) if a > 0.0 else 0.0
    return float(np.linalg.norm(w + s * u - t * v)), s
