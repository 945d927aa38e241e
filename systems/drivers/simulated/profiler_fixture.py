"""Draws the true profiler fixture from the seed: sensor, torch, straightedge and sphere, each off its nominal pose."""

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.workpieces.part import WeldPart
from weldcal.systems.drivers.simulated.profiler_world import (
    ProfilerFixture,
    ProfilerTruth,
    box_mesh,
    post_mesh,
    straightedge_mesh,
    under_straightedge,
)
from weldcal.systems.drivers.simulated.rendered_scanner import random_pose_error
from weldcal.systems.jobs.profiler.config import ProfilerJob, pose_of


def draw_fixture(
    X_FS_drawn: RigidTransform,
    error_m: float,
    error_rad: float,
    job: ProfilerJob,
    rng: np.random.Generator,
    table_z_m: float,
    workpiece: WeldPart | None,
    X_BP: RigidTransform | None,
) -> ProfilerFixture:
    """Draw the deviations of the true fixture from its nominal dimensions and poses."""
    off = random_pose_error(rng, error_m, error_rad)
    X_FS = RigidTransform(X_FS_drawn.rotation() @ off.rotation(), X_FS_drawn.translation() + off.translation())
    bent = rng.normal(size=3)
    tip = np.array(job.torch.tip_m) + 1e-3 * job.torch.error_mm * bent / np.linalg.norm(bent)
    s = job.straightedge
    moved = random_pose_error(rng, 1e-3 * s.translation_mm, np.deg2rad(s.rotation_deg))
    thought = pose_of(s.xyz_m, s.rpy_deg)
    X_BE = RigidTransform(thought.rotation() @ moved.rotation(), thought.translation() + moved.translation())
    aside = rng.normal(size=3)
    center = np.array(job.ball.xyz_m) + 1e-3 * job.ball.translation_mm * aside / np.linalg.norm(aside)
    radius = 1e-3 * job.ball.radius_mm
    truth = ProfilerTruth(
        X_FS, tip, np.array(X_BE.translation()), X_BE.rotation().matrix()[:, 0].copy(), center, radius
    )
    meshes = [
        (straightedge_mesh(1e-3 * s.length_mm, 1e-3 * s.width_mm).transformed(X_BE), 0.0),
        *(
            (post_mesh(p, table_z_m), 0.6)
            for p in (under_straightedge(X_BE, 1e-3 * s.width_mm), center - [0.0, 0.0, 0.9 * radius])
        ),
        (box_mesh([0.45, 0.0, table_z_m - 0.02], [1.5, 1.2, 0.04]), 0.6),
    ]
    if workpiece is not None and X_BP is not None:
        meshes.append((workpiece.mesh.transformed(X_BP), 0.0))
    return ProfilerFixture(truth, X_BE, job, tuple(meshes), X_FS_drawn)
