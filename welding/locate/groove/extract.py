"""Extracts the weld seam of a V-groove from a point cloud without a drawing, on flat faces and on bent ones.

Openings in faces are found coarsely (search); slices across them are fitted with a V (section), each slice with points
of its own; the offsets of the centres are smoothed along the line, the line is moved by them until it converges
(measure). A face bent over a cylinder is unrolled first, measured as a flat one and rolled back. Every figure has a
sigma, scaled by the observed scatter of neighbouring slices.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import WeldcalError
from weldcal.welding.locate.bent_face import LEAST_RADIUS_M, BentFace, find_bent_faces
from weldcal.welding.locate.groove.measure import measure_groove
from weldcal.welding.locate.groove.seam import GrooveConfig, GrooveNotFound, GrooveSeam, SeveralGrooves
from weldcal.welding.locate.groove.search import find_grooves
from weldcal.welding.locate.planes import Floats, finite_points, thinned
from weldcal.welding.seam.curve import SeamCurve

MOST_RADIUS_M = 1.0  # over 0.3 m a larger radius sags by 11 mm or less, and counts as flat
MARGIN_M = 0.020  # beyond the face found: a choice, a groove's own width and more; wider only costs points
GROUND_REACH_M = 0.030  # the ends of a bent plate are inclined: the ground beyond is that much further away, unrolled
COARSE_POINTS, COARSE_CELL_M = 800_000, 0.0006  # for the search: a groove 2 mm wide is still three cells wide


def extract_groove(
    points_A: npt.NDArray[np.floating],
    *,
    hint_A: npt.ArrayLike | None = None,
    start_A: npt.ArrayLike | None = None,
    config: GrooveConfig | None = None,
) -> GrooveSeam:
    """Extract the V-groove from a cloud (N,3) or (H,W,3), metres, z roughly up out of the face, NaN where unmeasured.

    ``hint_A`` (3,): where several grooves are in view, the one nearest to this point. start_A (3,): the seam starts at
    the end nearest to it; without it at the end nearest to the origin of A (the robot, for a cloud in its base).

    Raises:
        GrooveNotFound, SeveralGrooves, GrooveTooNarrow, GrooveUncertain: in a sentence; InputError: wrong shape.
    """
    config = config or GrooveConfig()
    (points,) = finite_points([points_A])
    if len(points) < 1000:
        raise GrooveNotFound(f"The cloud has only {len(points)} points: move the workpiece into view.")
    bent, points, failures = bent_seams(points, config, start_A)
    seams, noise, pitch = list(bent), 0.0, 0.0
    if len(points) >= 1000:
        coarse, noise, pitch = find_grooves(thinned(points, COARSE_POINTS, COARSE_CELL_M), config.search)
        for groove in coarse:
            try:
                seams.append(measure_groove(points, groove, config, start_A))
            except WeldcalError as error:
                failures.append(error)
    if not seams and failures:
        # The refusal of a real groove is more useful than that of an opening that is not a groove.
        raise next((e for e in failures if not isinstance(e, GrooveNotFound)), failures[0])
    if not seams:
        depth = 2.0 * max(4.0 * noise, 0.0008)
        raise GrooveNotFound(
            f"No groove in any face: one longer than {1e3 * config.search.shortest_m:.0f} mm, deeper than "
            f"{1e3 * depth:.1f} mm and from {1e3 * config.least_pitches * pitch:.1f} to "
            f"{1e3 * config.search.max_width_m:.0f} mm wide would be found with points {1e3 * pitch:.1f} mm apart."
        )
    if len(seams) == 1:
        return seams[0]
    if hint_A is None:
        where = "; ".join(f"{1e3 * g.s[-1]:.0f} mm long near {_mm(g.root[len(g.root) // 2])}" for g in seams)
        raise SeveralGrooves(f"{len(seams)} grooves are in view ({where}): name one by a point near it.")
    hint = np.asarray(hint_A, dtype=np.float64)
    return min(seams, key=lambda g: float(np.linalg.norm(g.root - hint, axis=1).min()))


def _mm(p: Floats) -> str:
    return "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * p))


def bent_seams(
    points: Floats, config: GrooveConfig, start_A: npt.ArrayLike | None
) -> tuple[list[GrooveSeam], Floats, list[WeldcalError]]:
    """Find the grooves of all bent faces in a cloud (N,3) m.

    Returns the seams, the points outside these faces, and the errors of grooves refused.
    """
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
    """Roll the seam of an unrolled face back onto the cylinder, in the cloud's frame.

    The arc lengths are those of its root there.
    """
    root = face.rolled(seam.root)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(root, axis=0), axis=1))])

    def along(x: float) -> float:
        return float(np.interp(x, seam.s, s))

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
        bend_radius=face.radius_m,
    )
