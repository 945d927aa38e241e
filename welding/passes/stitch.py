"""Compute the pieces of a seam along which the arc burns in a stitched weld."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from weldcal.models.errors import InputError

LEAST_S = 0.3  # a choice: the travel time of a piece and of a pause, six times the window of a measured speed
_ROUNDING = 1e-9  # of the number of pieces before a place
_LEAST_SHARE = 0.5  # a choice: a last piece that the seam's end cuts shorter than this share is left out


class StitchError(InputError):
    """Stitches that cannot be welded."""


class Stitch(NamedTuple):
    """Where the arc starts and ends, m along the seam."""

    start: float
    end: float


@dataclass(frozen=True)
class StitchConfig:
    """Settings of the stitches; on_m of 0: the arc burns along the whole seam.

    Attributes:
        on_m, off_m: length of a piece, and of the pause after it.
        from_m: where the first piece starts.
        order: along, or middle_out: the piece in the middle is welded first, then one on either side by turns.
    """

    on_m: float = 0.0
    off_m: float = 0.0
    from_m: float = 0.0
    order: str = "along"

    @property
    def middle_out(self) -> bool:
        """Whether the piece in the middle is welded first."""
        return self.order == "middle_out"

    def __post_init__(self) -> None:
        if self.order not in ("along", "middle_out"):
            raise StitchError(f"welding.stitch.order must be along or middle_out, not '{self.order}'.")
        if not all(math.isfinite(v) and v >= 0.0 for v in (self.on_m, self.off_m, self.from_m)):
            raise StitchError("A stitch needs lengths of zero or more.")
        if (self.on_m > 0.0) != (self.off_m > 0.0):
            raise StitchError("A stitch needs a length with the arc on and one with it off, both above zero.")

    def check(self, speed_m_s: float) -> None:
        """Raise StitchError for a piece or a pause that is over too soon at a speed."""
        least_m = LEAST_S * speed_m_s
        if self.on_m and min(self.on_m, self.off_m) < least_m:
            raise StitchError(
                f"A stitch and the pause after it must be at least {1e3 * least_m:.3g} mm long at"
                f" {1e3 * speed_m_s:g} mm/s: raise on_mm and off_mm."
            )

    def pieces(self, length_m: float) -> list[Stitch]:
        """The pieces of a seam in the order of welding."""
        found: list[Stitch] = []
        at = 0.0
        while at < length_m and (piece := self.piece(at, 0.0, length_m)) is not None:
            found.append(piece)
            at = piece.start + (self.on_m or length_m)
        if self.middle_out:
            found = [found[k] for k in sorted(range(len(found)), key=lambda k: (abs(2 * k - len(found) + 1), k))]
        return found

    def piece(self, s: float, start: float, end: float) -> Stitch | None:
        """Return the first piece that ends beyond s m, on a seam from start to end m; None where there is none."""
        if self.on_m == 0.0:
            return Stitch(start, end)
        first, pitch = start + self.from_m, self.on_m + self.off_m
        k = max(0, math.floor((s - first - self.on_m) / pitch + _ROUNDING) + 1)
        at = first + k * pitch
        return None if at + _LEAST_SHARE * self.on_m > end else Stitch(at, min(at + self.on_m, end))
