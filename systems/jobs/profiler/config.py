"""Configuration of the profiler job.

Nominal torch, straightedge and sphere, their deviations, and the stages in order.
"""

import dataclasses as dc

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

STAGES = ("edge", "sphere", "seam")


@dc.dataclass
class Torch:
    """The pointed torch beside the profiler: nominal tip position in F, and the deviation of the true one."""

    tip_m: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.125])
    error_mm: float = 2.5


@dc.dataclass
class Straightedge:
    """A bevelled straightedge on a post: nominal centre and orientation (x along the edge, z up), and its deviation."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.62, -0.02, 0.14])
    rpy_deg: list[float] = dc.field(default_factory=lambda: [6.0, -5.0, 35.0])
    length_mm: float = 140.0
    width_mm: float = 22.0
    translation_mm: float = 3.0
    rotation_deg: float = 1.0


@dc.dataclass
class Ball:
    """A sphere on a post: nominal centre, and its deviation."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.66, 0.22, 0.16])
    radius_mm: float = 20.0
    translation_mm: float = 3.0


@dc.dataclass
class EdgeStage:
    """Scans of the straightedge: number of scans, number of held-out scans, largest tilt."""

    scans: int = 40
    held_out: int = 8
    tilt_deg: float = 28.0


@dc.dataclass(kw_only=True)
class SphereStage:
    """Scans and touches of the sphere."""

    scans: int = 28
    held_out: int = 6
    touches: int = 24
    tilt_deg: float = 26.0
    descent_mm_s: float = 6.0
    gap_mm: float = 10.0  # nominal height of the tip above the sphere at which the descent begins
    deepest_mm: float = 10.0  # below the nominal sphere, at which the touch is abandoned


@dc.dataclass(kw_only=True)
class SeamStage:
    """The passes of the profiler along the groove, and the following pass of the torch."""

    passes: int = 2  # forward and back: the robot's error differs between passes
    pass_mm_s: float = 25.0
    every_mm: float = 2.0  # period of the profiles
    stand_off_mm: float = 85.0  # distance of the plate from the profiler
    torch_mm_s: float = 12.0
    above_root_mm: float = 2.0  # height of the torch's path
    ends_mm: float = 12.0  # not measured at both ends of the seam
    seam_length_mm: float | None = None  # length of the seam to measure


@dc.dataclass(kw_only=True)
class ProfilerJob:
    """The stages of the job: edge, sphere and seam in this order.

    The seam stage uses the result of the sphere stage.
    """

    stages: list[str] = dc.field(default_factory=lambda: ["edge", "sphere", "seam"])
    torch: Torch = dc.field(default_factory=Torch)
    straightedge: Straightedge = dc.field(default_factory=Straightedge)
    ball: Ball = dc.field(default_factory=Ball)
    edge: EdgeStage = dc.field(default_factory=EdgeStage)
    sphere: SphereStage = dc.field(default_factory=SphereStage)
    seam: SeamStage = dc.field(default_factory=SeamStage)
    # per axis: error of the flange position that the controller reports, drawn at each pose
    robot_sigma_mm: float = 0.06
    clearance_mm: float = 6.0  # nominal distance between torch or profiler and the scanned object
    near_mm: float = 72.0  # the depth range of the calibration
    far_mm: float = 105.0
    half_width_mm: float = 17.0
    maximum_time_s: float = 600.0


def pose_of(xyz_m: list[float], rpy_deg: list[float]) -> RigidTransform:
    """Return the pose of a scenario's position (m) and roll-pitch-yaw (deg)."""
    return RigidTransform(RollPitchYaw(np.deg2rad(rpy_deg)), xyz_m)


def edge_as_thought(job: ProfilerJob) -> tuple[Array, Array]:
    """Return the nominal edge: a point (3,) m of the straightedge's edge and its direction (3,), in B."""
    X = pose_of(job.straightedge.xyz_m, job.straightedge.rpy_deg)
    return np.array(X.translation()), X.rotation().matrix()[:, 0].copy()


def check_profiler_job(job: ProfilerJob | None, *, has_profiler: bool, has_groove: bool, tool: str) -> None:
    """Check the profiler job of a scenario.

    Raises:
        InputError: one sentence that says what to change.
    """
    assert job is not None
    if not has_profiler:
        raise InputError("profiler_job needs a profiler: write profiler: !RenderedProfiler {} in the scenario.")
    if tool != "none":
        raise InputError("The profiler's torch replaces the tool: write tool: none in the scenario.")
    order = [stage for stage in STAGES if stage in job.stages]
    if not job.stages or order != job.stages:
        raise InputError(f"profiler_job.stages are some of {', '.join(STAGES)}, in this order, not {job.stages}.")
    if "seam" in job.stages and "sphere" not in job.stages:
        raise InputError("A seam needs the torch's tip, which the touches measure: write stages: [sphere, seam].")
    if len(job.torch.tip_m) != 3 or not job.torch.tip_m[2] > 0.03:
        raise InputError("profiler_job.torch.tip_m has three numbers, and the tip is 0.03 m or more before the flange.")
    if "seam" in job.stages and not has_groove:
        raise InputError("A seam needs a workpiece in the scenario.")
    if job.edge.scans < 8 or job.sphere.scans < 6 or job.sphere.touches < 6:
        raise InputError("Take 8 scans of the edge, 6 of the sphere and 6 touches of it, or more.")
    if min(job.edge.held_out, job.sphere.held_out) < 1:
        raise InputError("One scan or more must be held out: held_out must be positive.")
    if not 0.0 < job.near_mm < job.far_mm or min(job.half_width_mm, job.robot_sigma_mm, job.ball.radius_mm) <= 0.0:
        raise InputError("The profiler's field, the sphere's radius and the robot's sigma must be positive.")
    if job.seam.passes < 1:
        raise InputError("A seam needs seam.passes of 1 or more.")
    if min(job.sphere.descent_mm_s, job.seam.pass_mm_s, job.seam.every_mm, job.seam.torch_mm_s) <= 0.0:
        raise InputError("The descent, both passes' speeds and the distance of profiles must be positive.")
