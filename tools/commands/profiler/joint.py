"""weldcal profiler planes and joint: the pose on the flange from planes, or from edge, sphere and planes together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
import typer
from numpy.typing import NDArray

from weldcal.calibration.errors import FeatureNotFound
from weldcal.calibration.geometry.se3 import pose
from weldcal.calibration.profiler.combined.planes import line_of, plane_scans
from weldcal.calibration.profiler.combined.scans import EdgeScans, FeatureScans, edge_scans, sphere_scans
from weldcal.calibration.profiler.combined.solve import JointEstimate, solve_joint
from weldcal.calibration.profiler.depth_sign import WORDS
from weldcal.calibration.profiler.edge.features import near_face
from weldcal.calibration.profiler.edge.model import EdgeState
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.joint import sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, LimitOption, Outcome, command, option
from weldcal.tools.commands.profiler.edge import SIGMAS_MM, EdgeShown, edge_by_noise, edge_shown
from weldcal.tools.commands.profiler.files import Measurements
from weldcal.tools.commands.profiler.result import (
    RadiusOption,
    Sigmas,
    UnitOption,
    check_number,
    figures_of,
    finish,
    outcome_of,
    read_measurements,
    stated_correction,
    with_warnings,
)
from weldcal.tools.commands.profiler.sphere import decided_sphere
from weldcal.tools.report.first_screen import check_limit

MOST_PLANES = 3
_AFFINE = SphereSigmas().affine


def edge_part(shown: EdgeShown, sigmas: Sigmas, feature: str, side: str, origin: Floats) -> EdgeScans:
    """Return the scans of an edge about its own estimate, without outliers; a break where raw profiles show a corner."""
    poses, points = shown.seen()
    e, sigmas = shown.fit or edge_by_noise(poses, points, sigmas)
    faces, away = None, -1.0 if shown.words.get("z_grows") == WORDS["towards"] else 1.0
    if feature in ("bar", "step"):
        profiles = [p for p, kept in zip(shown.file.profiles or (), shown.keep, strict=True) if kept]
        near = cast(Literal["left", "right"], side)
        faces = np.array(
            [near_face(p, at, near) for p, at in zip(profiles, shown.points[shown.keep], strict=True)]
        )[e.inliers]
    return edge_scans(
        poses[e.inliers],
        points[e.inliers],
        EdgeState(e.rotation, e.translation, e.point, e.direction),
        sigma_xz_m=np.array([sigmas.x_m, sigmas.z_m]),
        origin=origin,
        faces=faces,
        away=away,
    )


def sphere_part(data: SphereData, sigmas: SphereSigmas, origin: Floats) -> FeatureScans:
    """Return the scans of a sphere about its own estimate, without wrong scans."""
    data = replace(data, touches=None, tip=None, touch_q=None, sensor=None)
    e = sphere_joint(data, "affine", sigmas)
    kept = data.without(*e.wrong_poses)
    arcs = [p[np.isfinite(p).all(axis=1)] for p in kept.profiles]
    return sphere_scans(kept.poses, arcs, data.radius_m, e.center, pose(e.rotation, e.translation), origin)


@dataclass(frozen=True, eq=False)
class PlanesShown:
    """Poses, profiles (m, 2) m and the plane (n,) of each profile that shows a line; ``lost``: numbers of the others."""

    poses: FlangePoses
    profiles: tuple[Floats, ...]
    of: NDArray[np.intp]
    lost: list[int]


def planes_shown(files: Sequence[Measurements]) -> PlanesShown:
    """Return the profiles of planes; a file is of one plane, or its array ``plane`` numbers them.

    Raises:
        InputError: no profiles, or more than three planes.
    """
    R, t, profiles, of, lost = [], [], [], [], []
    for n, file in enumerate(files):
        if file.profiles is None:
            raise InputError("The file has no 'profiles' of a plane. Give (n, m, 2), or 'xz' with the lengths 'n'.")
        poses = cast(FlangePoses, file.poses())
        check_number(poses, (len(file.profiles),), "profiles")
        plane = file.arrays.get("plane", np.zeros(len(poses)))
        check_number(poses, plane.shape, "numbers 'plane'")
        for k, p in enumerate(file.profiles):
            try:
                line_of(p)
            except FeatureNotFound:
                lost.append(len(lost) + len(profiles))
                continue
            R, t, profiles = [*R, poses.rotation[k]], [*t, poses.translation[k]], [*profiles, p]
            of.append((n, float(plane[k])))
    if not profiles:
        raise FeatureNotFound("No profile shows a single line: bring the plane alone into the laser line.")
    known = sorted(set(of))
    if len(known) > MOST_PLANES:
        raise InputError(f"{len(known)} planes are more than {MOST_PLANES}: give the profiles of up to {MOST_PLANES}.")
    return PlanesShown(
        FlangePoses(np.array(R), np.array(t)), tuple(profiles), np.array([known.index(one) for one in of]), lost
    )
