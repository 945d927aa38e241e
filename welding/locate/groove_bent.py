"""Grooves in faces bent over a cylinder: unrolled, measured as in a flat face, and rolled back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import WeldcalError
from weldcal.welding.locate.bent_face import LEAST_RADIUS_M, BentFace, find_bent_faces
from weldcal.welding.locate.groove_measure import measure_groove
from weldcal.welding.locate.groove_seam import GrooveConfig, GrooveSeam
from weldcal.welding.locate.groove_search import find_grooves
from weldcal.welding.locate.planes import Floats, thinned
from weldcal.welding.seam.curve import SeamCurve

MOST_RADIUS_M = 1.0  # over 0.3 m a larger one sags by 11 mm or less, and its walls lean by less than 9 deg
MARGIN_M = 0.020
GROUND_REACH_M = 0.030  # the ends of a bent plate lean: the ground beyond lies that much further off, unrolled
COARSE_POINTS, COARSE_CELL_M = 800_000, 0.0006


def bent_seams(
    points: Floats, config: GrooveConfig, start_A: npt.ArrayLike | None
) -> tuple[list[GrooveSeam], Floats, list[WeldcalError]]:
    """The grooves of all bent faces in a cloud (N,3) m, the points that belong to none of these faces, and why others fail."""
    seams: list[GrooveSeam] = []
    failures: list[WeldcalError] = []
    rng = np.random.default_rng(config.search.seed)
    for face in find_bent_faces(points, (LEAST_RADIUS_M, MOST_RADIUS_M), rng, hollow=True):
        u = face.unrolled(points)
        mine = (np.abs(u[:, :2]) < np.array(face.reach_m) + MARGIN_M).all(axis=1) & (np.abs(u[:, 2]) < 0.05)
        start = face.unrolled(np.atleast_2d(np.zeros(3) if start_A is None else np.asarray(start_A, dtype=np.float64)))[
            0
        ]
        flat = u[mine]
        if len(flat) < 1000:
            continue
        leaning = replace(config, ground_reach_m=GROUND_REACH_M)
        for groove in find_grooves(thinned(flat, COARSE_POINTS, COARSE_CELL_M), config.search)[0]:
            try:
                seam = measure_groove(flat, groove, leaning, start)
                seams.append(_rolled(seam, face, "the robot" if start_A is None else "the point given"))
            except WeldcalError as error:
                failures.append(error)
        points = points[~mine]
    return seams, points, failures


def _rolled(seam: GrooveSeam, face: BentFace, start: str) -> GrooveSeam:
    """The seam of the unrolled face, back on the cylinder and in the cloud's frame; arc lengths are those of the root there."""
    root = face.rolled(seam.root)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(root, axis=0), axis=1))])

    def along(x: float) -> float:
        return float(np.interp(x, seam.s, s))

    middle = seam.root[len(seam.root) // 2]
    return replace(
        seam,
        curve=SeamCurve.from_points(root, up=face.up(seam.root)),
        root=root,
        left=face.rolled(seam.left),
        right=face.rolled(seam.right),
        s=s,
        gaps=tuple((along(a), along(b)) for a, b in seam.gaps),
        corners=tuple(along(c) for c in seam.corners),
        apexes=face.rolled(seam.apexes.reshape(-1, 3)),
        start=seam.start.replace("the point given", start),
        X_AF=face.at(float(middle[0]), float(middle[1]), 0.0),
        bend_radius=face.radius_m,
    )
