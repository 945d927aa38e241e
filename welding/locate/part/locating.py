"""Finds a part with a drawn seam in scans, and measures its joint along the seam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform

from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.seams import DrawnSeam
from weldcal.welding.locate.part.fit import into
from weldcal.welding.locate.part.joint import MOST_M, REACH_M, MeasuredJoint, measure_fit_up, measure_joint
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.part.registration import register_prepared
from weldcal.welding.locate.part.result import PartConfig, PartRegistration
from weldcal.welding.locate.part.scan import finite_points, prepare

Floats = npt.NDArray[np.float64]


def locate_part(
    points_B: npt.NDArray[np.floating] | Sequence[npt.NDArray[np.floating]],
    mesh: TriMesh,
    seam: DrawnSeam,
    X_BP_guess: RigidTransform | None = None,
    eye_B: npt.ArrayLike | None = None,
    *,
    X_BP_hint: RigidTransform | None = None,
    config: PartConfig | None = None,
) -> tuple[PartRegistration, MeasuredJoint]:
    """The pose of a part, and its joint in the part's frame as the scan shows it; see register_part and measure_joint.

    Raises:
        PartNotFound, AmbiguousPart, InputError: as register_part.
    """
    config = config or PartConfig()
    scan = prepare(finite_points(points_B), eye_B, config.min_points, config.seed)
    model = PartModel(mesh, config.seed)
    found = register_prepared(scan, model, X_BP_guess, X_BP_hint=X_BP_hint, matters_P=seam.points_P, config=config)
    near = [_about_seam(into(found.X_BP, v.measured), into(found.X_BP, v.eye[None])[0], seam) for v in scan.views]
    points, normals = (np.concatenate(part) for part in zip(*near, strict=True))
    seen = (points, normals, scan.pitch_m, model, seam)
    return found, replace(measure_joint(*seen), fit_up=measure_fit_up(*seen))


def _about_seam(points: Floats, eye: Floats, seam: DrawnSeam) -> tuple[Floats, Floats]:
    """All of the scan's points (N,3) in the box about the seam, with normals (N,3) towards the eye (3,)."""
    from weldcal.models.mesh import o3d

    reach = REACH_M + 2.0 * MOST_M
    low, high = seam.points_P.min(axis=0) - reach, seam.points_P.max(axis=0) + reach
    points = points[((points > low) & (points < high)).all(axis=1)]
    if len(points) < 20:
        return points[:0], points[:0]
    cloud: Any = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    normals = np.asarray(cloud.normals)
    return points, normals * np.where(np.sum(normals * (eye - points), axis=1) < 0.0, -1.0, 1.0)[:, None]
