"""The cell's surroundings as surfaces in the base: how near the arm comes to them, and which lines of sight they
block."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.planning.clearance import STANDING, LinkCapsule, body_ends
from weldcal.models.arms.kinematics import ArmModel, link_frames
from weldcal.models.arrays import Array
from weldcal.models.mesh import TriMesh
from weldcal.models.profilers import make_scene

# of the points along a capsule's axis, in its radii: a gap is too large by a thirtieth of the radius at most
_SPACING = 0.5
_STEP_RAD = 0.05  # a choice: 5 cm of the flange at a reach of 1 m; a step of half the size takes twice the time


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A thing that the arm must not touch: its surface in B, m, and how far the arm keeps away from it, m."""

    name: str
    mesh: TriMesh
    margin_m: float = 0.0

    @cached_property
    def _scene(self) -> Any:
        return make_scene(self.mesh)

    @cached_property
    def _closed(self) -> bool:
        return self.mesh.watertight()

    def __getstate__(self) -> dict[str, Any]:
        """Without the scene, which cannot be sent to another process."""
        return {name: value for name, value in vars(self).items() if name != "_scene"}

    def distance(self, points: Array) -> Array:
        """Distance (N,) m of points (N, 3); inside a closed surface it is negative."""
        query = np.ascontiguousarray(points, dtype=np.float32)
        if self._closed:
            return np.asarray(self._scene.compute_signed_distance(query).numpy(), dtype=float)
        return np.asarray(self._scene.compute_distance(query).numpy(), dtype=float)

    def blocks(self, eye: Array, targets: Array) -> bool:
        """Whether a line of sight from the eye (3,) to one of the targets (N, 3) meets the surface."""
        rays = np.hstack([np.broadcast_to(eye, targets.shape), targets - eye]).astype(np.float32)
        return bool((self._scene.cast_rays(np.ascontiguousarray(rays))["t_hit"].numpy() < 1.0).any())


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

    def touched_on_path(self, arm: ArmModel, bodies: Sequence[LinkCapsule], q_a: Array, q_b: Array) -> str:
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
