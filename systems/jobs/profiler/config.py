"""What a scenario says of a profiler's job: torch, straightedge and sphere as drawn, how far they may be off, what is done in which order."""

import dataclasses as dc

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.errors import InputError

STAGES = ("edge", "sphere", "seam")


@dc.dataclass
class Torch:
    """The pointed torch beside the profiler: its tip in F as drawn, and how far the real one is bent."""

    tip_m: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.125])
    error_mm: float = 2.5


@dc.dataclass
class Straightedge:
    """A bevelled straightedge on a post: its middle and how it lies as thought (x along the edge, z up), and by how much it is off."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.62, -0.02, 0.14])
    rpy_deg: list[float] = dc.field(default_factory=lambda: [6.0, -5.0, 35.0])
    length_mm: float = 140.0
    width_mm: float = 22.0
    translation_mm: float = 3.0
    rotation_deg: float = 1.0


@dc.dataclass
class Ball:
    """A sphere on a post, its centre as thought, and by how much it is off."""

    xyz_m: list[float] = dc.field(default_factory=lambda: [0.66, 0.22, 0.16])
    radius_mm: float = 20.0
    translation_mm: float = 3.0


@dc.dataclass
class EdgeStage:
    """Scans of the straightedge: how many, how many more that the calibration does not see, the largest tilt."""

    scans: int = 40
    held_out: int = 8
    tilt_deg: float = 28.0


@dc.dataclass
class SphereStage:
    """Scans and touches of the sphere."""

    scans: int = 28
    held_out: int = 6
    touches: int = 24
    tilt_deg: float = 26.0
    descent_mm_s: float = 6.0
    gap_mm: float = 10.0  # of the tip above the sphere, as thought, where the descent begins
    deepest_mm: float = 10.0  # below where the sphere is thought to be: then the touch is given up


@dc.dataclass
class SeamStage:
    """The pass of the profiler along the groove, and of the torch after it."""

    passes: int = 2  # forth and back: the robot's own error is another one each time
    pass_mm_s: float = 25.0
    every_mm: float = 2.0  # a profile this often
    stand_off_mm: float = 85.0  # of the plate, from the profiler
    torch_mm_s: float = 12.0
    above_root_mm: float = 2.0  # where the torch runs
    ends_mm: float = 12.0  # left out at both ends of the seam
    seam_length_mm: float | None = None  # only this much of it


@dc.dataclass
class ProfilerJob:
    """What is done: stages of edge, sphere and seam in this order; a seam takes what the sphere's stage found."""

    stages: list[str] = dc.field(default_factory=lambda: ["edge", "sphere", "seam"])
    torch: Torch = dc.field(default_factory=Torch)
    straightedge: Straightedge = dc.field(default_factory=Straightedge)
    ball: Ball = dc.field(default_factory=Ball)
    edge: EdgeStage = dc.field(default_factory=EdgeStage)
    sphere: SphereStage = dc.field(default_factory=SphereStage)
    seam: SeamStage = dc.field(default_factory=SeamStage)
    # per axis, of where the flange is against where the controller says, anew at each pose
    robot_sigma_mm: float = 0.06
    clearance_mm: float = 6.0  # between torch or profiler and what is scanned, as thought
    near_mm: float = 72.0  # the field in which the calibration measures
    far_mm: float = 105.0
    half_width_mm: float = 17.0
    maximum_time_s: float = 600.0


def pose_of(xyz_m: list[float], rpy_deg: list[float]) -> RigidTransform:
    """A pose as written in a scenario."""
    return RigidTransform(RollPitchYaw(np.deg2rad(rpy_deg)), xyz_m)


def edge_as_thought(job: ProfilerJob) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A point (3,) m of the straightedge's edge and its direction (3,), in B."""
    X = pose_of(job.straightedge.xyz_m, job.straightedge.rpy_deg)
    return np.array(X.translation()), X.rotation().matrix()[:, 0].copy()


def check_profiler_job(job: ProfilerJob | None, *, has_profiler: bool, has_groove: bool, tool: str) -> None:
    """Refuse what no profiler's cell could do.

    Raises:
        InputError: one sentence that says what to change.
    """
    if job is None:
        if has_profiler:
            raise InputError("A profiler needs something to do: write profiler_job: {} in the scenario.")
        return
    if not has_profiler:
        raise InputError("profiler_job needs a profiler: write profiler: !RenderedProfiler {} in the scenario.")
    if tool != "none":
        raise InputError("The profiler's torch takes the tool's place: write tool: none in the scenario.")
    order = [stage for stage in STAGES if stage in job.stages]
    if not job.stages or order != job.stages:
        raise InputError(f"profiler_job.stages are some of {', '.join(STAGES)}, in this order, not {job.stages}.")
    if "seam" in job.stages and "sphere" not in job.stages:
        raise InputError("A seam needs the torch's tip, which the touches find: write stages: [sphere, seam].")
    if len(job.torch.tip_m) != 3 or not job.torch.tip_m[2] > 0.03:
        raise InputError("profiler_job.torch.tip_m has three numbers, and the tip is 0.03 m or more before the flange.")
    if "seam" in job.stages and not has_groove:
        raise InputError("A seam needs a workpiece in the scenario.")
    if job.edge.scans < 8 or job.sphere.scans < 6 or job.sphere.touches < 6:
        raise InputError("Take 8 scans of the edge, 6 of the sphere and 6 touches of it, or more.")
    if min(job.edge.held_out, job.sphere.held_out) < 1:
        raise InputError("Leave one scan out or more: held_out must be positive.")
    if not 0.0 < job.near_mm < job.far_mm or min(job.half_width_mm, job.robot_sigma_mm, job.ball.radius_mm) <= 0.0:
        raise InputError("The profiler's field, the sphere's radius and the robot's sigma must be positive.")
    if job.seam.passes < 1:
        raise InputError("A seam needs seam.passes of 1 or more.")
    if min(job.sphere.descent_mm_s, job.seam.pass_mm_s, job.seam.every_mm, job.seam.torch_mm_s) <= 0.0:
        raise InputError("The descent, both passes' speeds and the distance of profiles must be positive.")
