"""The fit-up of two parts along a seam: gap, misalignment and angle as the scan shows them, and their limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from weldcal.models.errors import InputError, WeldcalError
from weldcal.models.files import read_text
from weldcal.models.text_tables import cells_of, lines_of

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FitUp:
    """How two parts stand to each other along a seam, by the scan; NaN where it does not show that.

    Attributes:
        s_m: (K,) places along the seam, m.
        values: gap (m, between the edges of the two sides), misalignment (m, the left face above the right one) and
            angle (rad, how much wider the joint opens than drawn), each (K,).
        sigmas: their standard deviations.
    """

    s_m: Floats
    values: Mapping[str, Floats]
    sigmas: Mapping[str, Floats]


FIT_UP = {"gap": ("mm", 1e3), "misalignment": ("mm", 1e3), "angle": ("deg", 180.0 / math.pi)}
"""The quantities of a fit-up, with the unit in which an operator reads them."""


SHOWN_BY = {"butt": tuple(FIT_UP), "v_groove": ("angle",), "fillet": ("gap", "angle"), "lap": ("gap",)}
"""What the scan of a joint shows, unless something hides it."""


class FitUpOutside(WeldcalError):
    """The fit-up is out of the limits that the user gives."""


def read_limits(path: Path) -> dict[str, tuple[float, float]]:
    """Read a table of limits: quantity, unit, least, most; an empty cell is no limit.

    Angles are deviations from the drawing.

    Returns:
        (least, most) in m and rad, by quantity.

    Raises:
        InputError: naming the line that is at fault.
    """
    limits: dict[str, tuple[float, float]] = {}
    for number, line in lines_of(read_text(path), ("#",)):
        if not limits and line.startswith("quantity"):
            continue
        try:
            name, unit, *ends = cells_of(line.split("#")[0], ",")
            least, most = (float(end) if end else off for end, off in zip(ends, (-math.inf, math.inf), strict=True))
            if unit != FIT_UP[name][0] or not least <= most:
                raise ValueError
        except (KeyError, ValueError):
            raise InputError(
                f"'{path.name}' line {number}: write quantity,unit,least,most, such as gap,mm,0,1.6."
            ) from None
        limits[name] = (least / FIT_UP[name][1], most / FIT_UP[name][1])
    return limits


def check_fit_up(found: FitUp, limits: Mapping[str, tuple[float, float]], joint: str) -> None:
    """Check a fit-up against limits; what the scan shows nowhere is out of its limits too.

    Raises:
        FitUpOutside: with the place, the value and the limit, of the quantity that is farthest beyond in units of its
            sigma.
    """
    beyond, worst = 0.0, ""
    for name, (least, most) in limits.items():
        if name not in found.values:
            if name in SHOWN_BY[joint]:
                raise FitUpOutside(
                    f"The scan does not show the joint's {name}, which has a limit: scan it from another side."
                )
            continue
        value, sigma, (unit, factor) = found.values[name], found.sigmas[name], FIT_UP[name]
        over = np.nan_to_num(np.maximum(value - most, least - value) / sigma, nan=-1.0)
        k = int(np.argmax(over))
        if over[k] > beyond:
            beyond, limit = float(over[k]), most if value[k] > most else least
            worst = (
                f"The fit-up is out of its limits: at {1e3 * found.s_m[k]:.0f} mm of the seam the {name} is"
                f" {factor * value[k]:.2f} {unit} (sigma {factor * sigma[k]:.2f}), and its limit is {factor * limit:g}"
                f" {unit}. Fit the parts anew and scan again."
            )
    if worst:
        raise FitUpOutside(worst)
