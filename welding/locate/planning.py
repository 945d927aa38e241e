"""Plans root and tip path from scans: by the drawing registered to them, or from the cloud alone."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.arrays import Array
from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.mesh import TriMesh
from weldcal.models.tool import WeldingTool
from weldcal.models.workpieces.part import Part, WeldPart
from weldcal.models.workpieces.plate import Workpiece
from weldcal.models.workpieces.seams import DrawnSeam
from weldcal.models.workpieces.seat import Press
from weldcal.welding.locate.part.fit_up import FitUp
from weldcal.welding.locate.planes import Floats, finite_points, into
from weldcal.welding.locate.registration import register_workpiece
from weldcal.welding.seam.curve import SeamCurve, ringed

if TYPE_CHECKING:
    from weldcal.welding.locate.part.joint import MeasuredJoint
    from weldcal.welding.locate.part.model import PartModel
    from weldcal.welding.locate.part.registration import Candidates
    from weldcal.welding.locate.part.result import PartConfig, PartRegistration
    from weldcal.welding.locate.part.scan import PreparedScan

METHODS = ("cad", "cloud")
SEARCHES = ("guess", "anywhere")
OVERLAP_M = 5e-3  # a choice: the length of a usual weld pool, so that the ring's start is melted again
TIP_AHEAD = 1.5  # in a bend the arc between torch and tip is longer than the chord


@dataclass
class PlanningMethod:
    """Method and search of the seam plan. A part from a file is always searched anywhere.

    Raises InputError for unknown ones.
    """

    method: str = "cad"  # cad: the CAD is registered to the scan; cloud: the groove is found in the scan without CAD
    search: str = "guess"  # search for the CAD: guess, near workpiece.pose_guess; anywhere, in the whole scan
    start_m: list[float] | None = None  # a cloud's seam starts at the end nearest to this; null: nearest to the robot

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"planning.method must be one of {', '.join(METHODS)}, not '{self.method}'.")
        if self.search not in SEARCHES:
            raise InputError(f"planning.search must be one of {', '.join(SEARCHES)}, not '{self.search}'.")


@dataclass(frozen=True, eq=False, kw_only=True)
class RootPlan:
    """The planned root of the groove in base, in the direction of travel.

    Attributes:
        root, up: (N,3) m and unit normals of the face.
        half_angle_rad: between a wall and the groove's middle plane.
        X_BP: where the drawing lies, where one was used.
        sigma_m: of the root sideways, rms along it: with a drawing that of the drawn groove, from which the real one
            may differ.
        across_m: (N,) of a part: that of the drawn root sideways, by the scan where it shows the root, else by the
            registration.
        fit_up: of a part: how the two sides of the joint stand to each other.
        rms_m: of the face's points about their plane.
        confidence: 0 to 1.
        summary: what was found, in a sentence.
    """

    root: Floats
    up: Floats
    half_angle_rad: float
    X_BP: RigidTransform | None
    sigma_m: float
    rms_m: float
    confidence: float
    summary: str
    across_m: Floats | None = None
    fit_up: FitUp | None = None


def locate_part(
    points_B: npt.NDArray[np.floating] | Sequence[npt.NDArray[np.floating]],
    mesh: TriMesh,
    seam: DrawnSeam,
    X_BP_guess: RigidTransform | None = None,
    eye_B: npt.ArrayLike | None = None,
    *,
    X_BP_hint: RigidTransform | None = None,
    config: "PartConfig | None" = None,
) -> "tuple[PartRegistration, MeasuredJoint]":
    """The pose of a part, and its joint in the part's frame as the scan shows it; see register_part and measure_joint.

    Raises:
        PartNotFound, AmbiguousPart, InputError: as register_part.
    """
    # only here: a plate, or a cloud alone, needs none of it
    from weldcal.welding.locate.part.joint import measure_fit_up, measure_joint
    from weldcal.welding.locate.part.registration import decided
    from weldcal.welding.locate.part.result import PartConfig

    clouds = finite_points(points_B)
    eyes = None if eye_B is None else np.asarray(eye_B, dtype=np.float64)
    places = [None if X is None else X.GetAsMatrix4() for X in (X_BP_guess, X_BP_hint)]
    key = b"|".join(b"" if a is None else a.tobytes() for a in (*clouds, mesh.vertices, mesh.triangles, eyes, *places))
    asked = clouds, mesh, eyes, X_BP_guess, X_BP_hint, config or PartConfig()
    scan, model, candidates = _shown(_Asked(sha256(key).digest() + repr(asked[-1]).encode(), asked))
    if isinstance(candidates, WeldcalError):
        raise candidates.with_traceback(None)
    found = decided(candidates, scan, model, seam.points_P)
    near = [_about_seam(into(found.X_BP, v.measured), into(found.X_BP, v.eye[None])[0], seam) for v in scan.views]
    points, normals = (np.concatenate(part) for part in zip(*near, strict=True))
    shown = (points, normals, scan.pitch_m, model, seam)
    return found, replace(measure_joint(*shown), fit_up=measure_fit_up(*shown))


@dataclass(frozen=True)
class _Asked:
    """A part and scans of it; equal by their content."""

    digest: bytes
    asked: Any = field(compare=False)


@lru_cache(1)
def _shown(of: _Asked) -> "tuple[PreparedScan, PartModel, Candidates | WeldcalError]":
    """Prepare a part and scans of it, and find where it may be: once for all seams of the part."""
    from weldcal.welding.locate.part.model import PartModel
    from weldcal.welding.locate.part.registration import candidates
    from weldcal.welding.locate.part.scan import prepare

    points, mesh, eyes, guess, hint, config = of.asked
    scan = prepare(points, eyes, config.min_points, config.seed)
    model = PartModel(mesh, config.seed)
    try:
        return scan, model, candidates(scan, model, guess, hint, config)
    except WeldcalError as refused:
        return scan, model, refused


def _about_seam(points: Floats, eye: Floats, seam: DrawnSeam) -> tuple[Floats, Floats]:
    """All of the scan's points (N,3) in the box about the seam, with normals (N,3) towards the eye (3,)."""
    from weldcal.models.mesh import o3d
    from weldcal.welding.locate.part.joint import MOST_M, REACH_M

    reach = REACH_M + 2.0 * MOST_M
    low, high = seam.points_P.min(axis=0) - reach, seam.points_P.max(axis=0) + reach
    points = points[((points > low) & (points < high)).all(axis=1)]
    if len(points) < 20:
        return points[:0], points[:0]
    cloud: Any = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    normals = np.asarray(cloud.normals)
    return points, normals * np.where(np.sum(normals * (eye - points), axis=1) < 0.0, -1.0, 1.0)[:, None]


def plan_part_root(
    points_B: npt.NDArray[np.floating] | Sequence[npt.NDArray[np.floating]],
    part: Part,
    X_BP_guess: RigidTransform,
    method: PlanningMethod,
    eye_B: npt.ArrayLike | None,
) -> RootPlan:
    """Plan the root of a drawn seam on a part from a file; the guess only decides between poses that look the same."""
    if method.method == "cloud":
        raise InputError(
            "planning.method: cloud finds grooves in plates; a part from a file is planned with method: cad."
        )
    found, joint = locate_part(points_B, part.mesh, part.seam, None, eye_B, X_BP_hint=X_BP_guess)
    seam = joint.seam.transformed(found.X_BP)
    left_P = joint.seam.left_P
    across_m = np.sqrt(np.einsum("ni,nij,nj->n", left_P, found.spread_at(part.seam_P), left_P))
    sigma_m = float(np.sqrt(np.mean(found.sigma_at(part.seam_P) ** 2)))
    return RootPlan(
        root=seam.points_P,
        up=seam.up_P,
        half_angle_rad=part.half_angle_rad,
        X_BP=found.X_BP,
        sigma_m=joint.sigma_m if math.isfinite(joint.sigma_m) else sigma_m,
        rms_m=found.rms_m,
        confidence=found.confidence,
        summary=f"{found.summary}; {joint.summary}",
        fit_up=joint.fit_up,
        across_m=np.full(len(left_P), joint.sigma_m) if math.isfinite(joint.sigma_m) else across_m,
    )


def plan_root(
    points_B: npt.NDArray[np.floating] | Sequence[npt.NDArray[np.floating]],
    workpiece: WeldPart,
    X_BP_guess: RigidTransform,
    method: PlanningMethod | None = None,
    eye_B: npt.ArrayLike | None = None,
) -> RootPlan:
    """Plan the root of the groove from a scan (N,3) or (H,W,3), metres in base; eye_B (3,): the scanner's position.

    Of a part from a file also from a list of V scans; eye_B is then (V,3).
    The cloud method takes nothing from `workpiece`; of several grooves it chooses the one nearest to the guess.

    Raises:
        WeldcalError: every refusal of registration, search and extraction, in a sentence.
    """
    method = method or PlanningMethod()
    if isinstance(workpiece, Part):
        return plan_part_root(points_B, workpiece, X_BP_guess, method, eye_B)
    if not isinstance(workpiece, Workpiece):
        raise InputError(f"'{workpiece.name}' cannot be located in a scan: use located_by: drawing.")
    if not isinstance(points_B, np.ndarray):
        raise InputError("Several scans are for a part from a file: scan a plate from one pose.")
    if method.method == "cloud":
        from weldcal.welding.locate.groove.extract import extract_groove

        groove = extract_groove(points_B, hint_A=X_BP_guess.translation(), start_A=method.start_m)
        return RootPlan(
            root=groove.curve.position(np.linspace(0.0, groove.curve.length, len(groove.curve.knots))),
            up=groove.curve.ups,
            half_angle_rad=groove.half_angle,
            X_BP=None,
            sigma_m=groove.typical_sigma,
            rms_m=groove.face_sigma,
            confidence=groove.confidence,
            summary=groove.summary,
        )
    if method.search == "anywhere":
        x = X_BP_guess.rotation().matrix()[:, 0]
        from weldcal.welding.locate.find_workpiece import find_workpiece

        found = find_workpiece(points_B, workpiece, turn_hint_rad=math.atan2(x[1], x[0]), eye_B=eye_B)
        registration, confidence, summary = found.registration, found.confidence, found.summary
    else:
        registration = register_workpiece(points_B, workpiece, X_BP_guess, eye_B=eye_B)
        confidence, summary = registration.confidence, registration.summary
    X_BP = registration.X_BP
    return RootPlan(
        root=workpiece.seam_P @ X_BP.rotation().matrix().T + X_BP.translation(),
        up=np.broadcast_to(workpiece.up_P, workpiece.seam_P.shape) @ X_BP.rotation().matrix().T,
        half_angle_rad=workpiece.half_angle_rad,
        X_BP=X_BP,
        sigma_m=registration.seam_sigma_m,
        rms_m=registration.rms_m,
        confidence=confidence,
        summary=summary,
    )


_Z = (0.0, 0.0, 1.0)


def plan_root_anyhow(
    points_B: npt.NDArray[np.floating] | list[Array],
    workpiece: WeldPart,
    X_BP_guess: RigidTransform,
    method: PlanningMethod,
    eye_B: Array,
    up_B: Array,
    plan: Callable[..., RootPlan] = plan_root,
) -> RootPlan:
    """`plan_root` where up_B (3,), the direction against gravity in the base, may differ from the base's z.

    Finding a part takes up for +z: the scan is turned about the base's origin, and the result is turned back.

    Raises:
        WeldcalError: as plan_root.
    """
    if tuple(up_B) == _Z:
        return plan(points_B, workpiece, X_BP_guess, method, eye_B)
    R_BU = RotationMatrix.MakeFromOneVector(up_B, 2)
    X_UB = RigidTransform(R_BU.inverse(), np.zeros(3))
    if method.start_m is not None:
        x, y, z = X_UB @ np.array(method.start_m)
        method = replace(method, start_m=[x, y, z])
    R_UB = X_UB.rotation().matrix()
    turned = [p @ R_UB.T for p in points_B] if isinstance(points_B, list) else points_B @ R_UB.T
    found = plan(turned, workpiece, X_UB @ X_BP_guess, method, eye_B @ R_UB.T)
    R = R_BU.matrix()
    X_BP = None if found.X_BP is None else X_UB.inverse() @ found.X_BP
    return replace(found, root=found.root @ R.T, up=found.up @ R.T, X_BP=X_BP)


def tip_seam(workpiece: WeldPart, X_BP: RigidTransform, tool: WeldingTool, length_m: float | None) -> SeamCurve:
    """The path of the seated tip's centre, in B.

    Where `length_m` of arc is given the seam ends there, and the path goes on.
    """
    seated = workpiece.seated(tool, Press(tool.press_axial_m, tool.press_lateral_m))
    line = workpiece.seam_P + seated.above_m * workpiece.up_P
    R = X_BP.rotation().matrix()
    ups = np.broadcast_to(workpiece.up_P, line.shape) @ R.T
    return _cut(line @ R.T + X_BP.translation(), ups, tool, length_m)


def _cut(line: Array, ups: Array, tool: WeldingTool, length_m: float | None) -> SeamCurve:
    """The seam along points (N,3) m.

    Where it is cut short, the groove goes on in front of the torch, and the tip is still in it.

    A ring is welded on over its start by OVERLAP_M, and the tip goes round ahead of the torch.
    """
    line, ups, turn_m = ringed(line, ups)
    if turn_m is not None:
        length_m = turn_m + OVERLAP_M if length_m is None else min(length_m, turn_m + OVERLAP_M)
    if length_m is None:
        return SeamCurve.from_points(line, up=ups)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    used = s <= length_m + TIP_AHEAD * tool.chord_m
    return SeamCurve.from_points(line[used], up=ups[used], length=length_m)


def seam_above(plan: RootPlan, tool: WeldingTool, length_m: float | None, above_m: float | None = None) -> SeamCurve:
    """The path of the seated tip's centre `above_m` over a planned root; None: by the groove's angle in the scan.

    Raises:
        InputError: for a root too short for a seam.
    """
    height = tool.tip_radius_m / math.sin(plan.half_angle_rad) - tool.seat_sink_m if above_m is None else above_m
    ups = np.broadcast_to(plan.up, plan.root.shape)
    return _cut(plan.root + height * ups, ups, tool, length_m)
