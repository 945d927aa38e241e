"""A weld seam from a cloud alone: the V-groove in a plate's face becomes its root and both shoulders, with their sigma.

No drawing takes part. Openings in faces are found coarsely (groove_search); slices across them are fitted with a V
(groove_section), each slice with points of its own; the centres' offsets are smoothed along the line, the line is moved
by them, and so again until it stays (groove_measure). A face bent over a cylinder is unrolled first (groove_bent). Every figure
carries a sigma, scaled by how much neighbouring slices really differ.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError, WeldcalError
from weldcal.welding.locate.groove_bent import bent_seams
from weldcal.welding.locate.groove_measure import measure_groove
from weldcal.welding.locate.groove_seam import GrooveConfig, GrooveNotFound, GrooveSeam, SeveralGrooves
from weldcal.welding.locate.groove_search import find_grooves
from weldcal.welding.locate.planes import Floats, thinned

COARSE_POINTS, COARSE_CELL_M = 800_000, 0.0006  # to find openings in: a groove 2 mm wide is still three cells wide


def extract_groove(
    points_A: npt.NDArray[np.floating],
    *,
    hint_A: npt.ArrayLike | None = None,
    start_A: npt.ArrayLike | None = None,
    config: GrooveConfig | None = None,
) -> GrooveSeam:
    """The V-groove in a cloud (N,3) or (H,W,3), metres, z roughly up out of the face, NaN where unmeasured.

    hint_A (3,): where several grooves are in view, the one nearest to this point. start_A (3,): the seam starts at the
    end nearest to it; without it at the end nearest to the origin of A (the robot, for a cloud in its base).

    Raises:
        GrooveNotFound, SeveralGrooves, GrooveTooNarrow, GrooveUncertain: in a sentence; InputError: wrong shape.
    """
    config = config or GrooveConfig()
    points = np.asarray(points_A, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3:
        raise InputError(f"A cloud has the shape (N, 3) or (H, W, 3): this one is {points.shape}.")
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
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
        # A groove that was seen but cannot be used says more than an opening that is none.
        raise next((e for e in failures if not isinstance(e, GrooveNotFound)), failures[0])
    if not seams:
        depth = 2.0 * max(4.0 * noise, 0.0008)
        raise GrooveNotFound(
            f"No groove in any face: one longer than {1e3 * config.search.shortest_m:.0f} mm, deeper than "
            f"{1e3 * depth:.1f} mm and from {1e3 * config.least_pitches * pitch:.1f} to "
            f"{1e3 * config.search.max_width_m:.0f} mm wide would be seen with points {1e3 * pitch:.1f} mm apart."
        )
    if len(seams) == 1:
        return seams[0]
    if hint_A is None:
        where = "; ".join(f"{1e3 * g.s[-1]:.0f} mm long near {_mm(g.root[len(g.root) // 2])}" for g in seams)
        raise SeveralGrooves(f"{len(seams)} grooves are in view ({where}): say which by a point near it.")
    hint = np.asarray(hint_A, dtype=np.float64)
    return min(seams, key=lambda g: float(np.linalg.norm(g.root - hint, axis=1).min()))


def _mm(p: Floats) -> str:
    return "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * p))
