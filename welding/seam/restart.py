"""Goes on with a broken weld: checks that the part was not moved, and cuts the seam a little before its crater."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform

from weldcal.models.errors import WeldcalError
from weldcal.welding.numerics import Array
from weldcal.welding.seam.curve import SeamCurve

MOVED_M = 1.0e-3  # a choice: two scans show such a move; the touch shows half of it, across the seam
SURE = 3.0  # sigma of the difference of two registrations, below which no part has moved
BEHIND_M = 4.0e-3  # a choice: half a weld pool and the tip's radius, so that the tip meets the open groove
SPARE_M = 0.5e-3  # a choice: the rest is splined anew, and its length changes by less
NEAR_START_M = 20e-3  # as far as the servo looks for the start
_KNOT_M = 0.5e-3  # as the pieces of an interrupted seam


class PartMoved(WeldcalError):
    """The part is not where it was when its weld broke off."""


class NoRoomBehindCrater(WeldcalError):
    """What is left of a broken seam is too short to be touched."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Restart:
    """Where a broken weld goes on.

    Attributes:
        seam, piece: numbers from 0 of the seam, and of its piece, that is not finished.
        p_BCrater: (3,) m, the torch where the arc went out; None: it has not burned on this seam.
        p_BBegin: (3,) m, the torch where the arc was first lit on it; None: at the planned start.
        felt: (N, 4) m in B: the points that the tip felt beside the crater and ahead of it, and their lag.
        X_BP: (4, 4), registered pose of the part then; None: not known. sigma_m: of that registration.
        overlap_m: of seam that is welded twice.
        crater_m: the crater's place on the whole seam, as the first run located that; NaN: as it is located now.
    """

    seam: int
    piece: int = 0
    p_BCrater: Array | None = None
    p_BBegin: Array | None = None
    felt: Array | None = None
    X_BP: Array | None = None
    sigma_m: float = math.nan
    overlap_m: float = 8e-3
    crater_m: float = math.nan

    def check_unmoved(self, seam: SeamCurve, X_BP: RigidTransform | None, sigma_m: float) -> None:
        """Check that the part is where it was.

        Args:
            seam: the planned line in B; X_BP: pose of the part now; sigma_m: of its registration.

        Raises:
            PartMoved: a place of the seam has moved by more than MOVED_M and by more than the two scans may be off.
        """
        if self.X_BP is None or X_BP is None:
            return
        moved = RigidTransform(self.X_BP) @ X_BP.inverse()
        p = seam.position(np.linspace(0.0, seam.length, 9))
        most = float(np.linalg.norm(np.asarray(moved.multiply(p.T)).T - p, axis=1).max())
        limit = max(MOVED_M, SURE * math.hypot(*np.nan_to_num([self.sigma_m, sigma_m])))
        if most > limit:
            raise PartMoved(
                f"The part was moved by {1e3 * most:.1f} mm since it was welded (limit {1e3 * limit:.1f} mm). Put the"
                " part back, or weld the rest by hand."
            )

    def cut(self, seam: SeamCurve, chord_m: float, run_up_m: float, window_m: float, from_m: float = 0.0) -> "CutSeam":
        """The rest of a seam, from `overlap_m` before its crater, but not from before its first arc.

        A new scan may place the planned start a few millimetres beside the one that was welded.

        Args:
            seam: the planned line in B, with what the groove goes on behind it.
            chord_m: from torch to tip; run_up_m: of the torch before its start.
            window_m: the tip must come down so far before the groove's end.
            from_m: where on the whole seam the line begins.

        Raises:
            NoRoomBehindCrater: the tip cannot touch the open groove.
        """
        if self.p_BCrater is None:
            return CutSeam(seam, None, from_m, from_m)
        crater = float(seam.project(self.p_BCrater))
        from_m += float(np.nan_to_num(self.crater_m - from_m - crater))
        begin = 0.0 if self.p_BBegin is None else seam.nearest(self.p_BBegin, 0.0, NEAR_START_M)
        start = min(max(begin, crater - self.overlap_m), seam.length)
        last = seam.drawn_m if seam.drawn_m > seam.length + window_m else seam.length
        down = min(start + chord_m - run_up_m, last - window_m - SPARE_M)
        if down < crater + BEHIND_M:
            raise NoRoomBehindCrater(
                f"The crater is {1e3 * (last - crater):.0f} mm before the groove's end, and the tip needs"
                f" {1e3 * (BEHIND_M + window_m + SPARE_M):.1f} mm to touch it: weld the rest by hand."
            )
        s = np.linspace(start, seam.drawn_m, max(9, round((seam.drawn_m - start) / _KNOT_M)))
        length = seam.length - start if seam.length < seam.drawn_m else None
        line = SeamCurve.from_points(seam.position(s), up=seam.up(s), length=length)
        return CutSeam(line, down - start, from_m + start, from_m + crater)


class CutSeam(NamedTuple):
    """The rest of a seam in B, where on it the tip comes down (None: as usual), start and crater on the whole, m."""

    line: SeamCurve
    down_m: float | None
    start_m: float
    crater_m: float

    def question(self, number: int) -> str:
        """What the operator is asked before the arm goes to seam `number`, from 0."""
        if self.down_m is None:
            return f"The arc will start at the beginning of seam {number + 1}. Start?"
        back, at = 1e3 * (self.crater_m - self.start_m), 1e3 * self.crater_m
        return f"The arc will start {back:.0f} mm before the crater at {at:.0f} mm of seam {number + 1}. Start?"
