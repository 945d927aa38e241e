"""Surfaces of a tool that a scanner sees: a surface of revolution with a free profile, and a ball of known radius."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.geometry.se3 import exp_rotation, frames_along
from weldcal.models.arrays import Array

Flags = NDArray[np.bool_]

KNOT_M = 0.005  # a choice: a nozzle's profile bends over some millimetres
CELL_M = 0.003  # a choice: some pixels of a scanner, beyond the width over which its noise is smooth
SPARE_M = 0.01  # a choice: no fit moves a surface farther
_STIFF_M = 0.002  # a choice: how far a knot that no point holds may leave the line of its neighbours
_ABOVE = 0.3  # of the radius: the ball ends in a rod above its middle


class Surface(Protocol):
    """A surface with parameters that a fit moves."""

    @property
    def size(self) -> int:
        """Number of parameters."""

    @property
    def middle(self) -> Array:
        """Its place (3,) m in F, about which a scan's turn is counted."""

    @property
    def around_m(self) -> float:
        """Distance from its place beyond which no point can lie on it."""

    def near(self, p: Array) -> Flags:
        """Which points (N, 3) may lie on it."""

    def rows(self, p: Array) -> tuple[Array, Array, Array]:
        """Distances (N,) m of points (N, 3), outward normals (N, 3), derivatives (N, size) of the distances."""

    def cells(self, p: Array) -> NDArray[np.int64]:
        """Return the cell (N, 2) of each point; the rows of a cell are averaged."""

    def prior(self) -> Array:
        """Return rows (M, size), of unit weight, that hold what no point holds."""

    def moved(self, x: Array) -> Self:
        """Return the surface after a change (size,) of its parameters."""


@dataclass(frozen=True, eq=False)
class Nozzle:
    """A surface of revolution: the middle (3,) m of its axis, directions (3, 3), radius (K,) m at the knots (K,) m.

    The third row of ``axes`` points along the wire towards the work. The knots count along it from the middle. Its
    parameters are the axis' shifts along the other two (m), its turns towards them (rad), and the radii.
    """

    centre: Array
    axes: Array
    knots: Array
    radii: Array
    reach_m: float

    @classmethod
    def about(cls, p_FW: Array, axis: Array, start_m: float, length_m: float, points: Array, reach_m: float) -> Nozzle:
        """Return the start of a fit.

        The part of the file's axis begins ``start_m`` behind the wire point p_FW (3,) m and is ``length_m`` long. Its
        radii are the medians of the points (N, 3) beside it.
        """
        axes = frames_along(axis[None])[0].T
        centre = p_FW - (start_m + 0.5 * length_m) * axes[2]
        number = max(3, round(length_m / KNOT_M) + 1)
        knots = np.linspace(-0.5 * length_m, 0.5 * length_m, number)
        start = cls(centre, axes, knots, np.full(number, np.nan), reach_m)
        s, r, _ = start._round(points)
        found = [r[(np.abs(s - k) < KNOT_M) & (r < reach_m)] for k in knots]
        known = np.array([float(np.median(f)) if len(f) else np.nan for f in found])
        usual = float(np.nanmedian(known)) if np.isfinite(known).any() else reach_m
        return replace(start, radii=np.where(np.isfinite(known), known, usual))

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 4 + len(self.knots)

    @property
    def middle(self) -> Array:
        """Its place (3,) m."""
        return self.centre

    @property
    def axis(self) -> Array:
        """Direction (3,) towards the work."""
        return np.asarray(self.axes[2])

    def _round(self, p: Array) -> tuple[Array, Array, Array]:
        """Place along the axis (N,) m, distance from it (N,) m, direction away from it (N, 2)."""
        q = (p - self.centre) @ self.axes.T
        r = np.maximum(np.sqrt(q[:, 0] ** 2 + q[:, 1] ** 2), 1e-9)
        return q[:, 2], r, q[:, :2] / r[:, None]

    @property
    def around_m(self) -> float:
        """Distance from its place beyond which no point can lie on it."""
        return float(np.hypot(self.knots[-1], self.reach_m)) + SPARE_M

    def near(self, p: Array) -> Flags:
        """Which points (N, 3) lie beside the part of the axis that is fitted."""
        s, r, _ = self._round(p)
        return np.asarray((s > self.knots[0]) & (s < self.knots[-1]) & (r < self.reach_m))

    def _weights(self, s: Array) -> tuple[NDArray[np.int64], Array]:
        step = self.knots[1] - self.knots[0]
        at = np.clip((s - self.knots[0]) / step, 0.0, len(self.knots) - 1.0)
        k = np.minimum(at.astype(np.int64), len(self.knots) - 2)
        return k, at - k

    def rows(self, p: Array) -> tuple[Array, Array, Array]:
        """Distances (N,) m of points (N, 3), outward normals (N, 3), derivatives (N, size) of the distances."""
        s, r, away = self._round(p)
        k, share = self._weights(s)
        slope = (self.radii[k + 1] - self.radii[k]) / (self.knots[1] - self.knots[0])
        scale = 1.0 / np.sqrt(1.0 + slope**2)
        e = scale * (r - (1.0 - share) * self.radii[k] - share * self.radii[k + 1])
        n = scale[:, None] * (np.column_stack([away, -slope]) @ self.axes)
        J = np.zeros((len(p), self.size))
        J[:, :2] = -scale[:, None] * away
        J[:, 2:4] = -(scale * (s + slope * r))[:, None] * away
        rows = np.arange(len(p))
        J[rows, 4 + k], J[rows, 5 + k] = -scale * (1.0 - share), -scale * share
        return e, n, J

    def cells(self, p: Array) -> NDArray[np.int64]:
        """Return the cell (N, 2) of each point: along the axis and around it."""
        s, _, away = self._round(p)
        around = np.arctan2(away[:, 1], away[:, 0]) * float(np.median(self.radii))
        return np.floor(np.column_stack([s, around]) / CELL_M).astype(np.int64)

    def prior(self) -> Array:
        """Return rows (K - 2, size) that hold knots without points on the line of their neighbours."""
        rows = np.zeros((len(self.knots) - 2, self.size))
        for i in range(len(rows)):
            rows[i, 4 + i : 7 + i] = np.array([1.0, -2.0, 1.0]) / _STIFF_M
        return rows

    def moved(self, x: Array) -> Nozzle:
        """Return the nozzle after a change (size,) of its parameters."""
        u, v, a = self.axes
        turn = exp_rotation(x[2] * np.cross(a, u) + x[3] * np.cross(a, v))
        return replace(
            self, centre=self.centre + x[0] * u + x[1] * v, axes=self.axes @ turn.T, radii=self.radii + x[4:]
        )

    def seen_deg(self, p: Array) -> float:
        """Return how much of the circle about the axis the points (N, 3) cover, degrees."""
        _, _, away = self._round(p)
        sectors = np.unique(np.floor(np.degrees(np.arctan2(away[:, 1], away[:, 0])) / 10.0))  # sectors of 10 degrees
        return 10.0 * len(sectors)

    def mouth(self, p: Array, within_m: float) -> tuple[float, float]:
        """Return where the nozzle ends, m along the axis from its middle, and the sigma of that.

        The noise of the last points of each strip along the axis makes up for their spacing from the end.
        """
        s, r, away = self._round(p)
        end_radius = self.radii[-1]
        on = (np.abs(r - end_radius) < within_m) & (s > 0.0)
        strip = np.floor(np.arctan2(away[on, 1], away[on, 0]) * end_radius / 5e-4).astype(int)  # strips of 0.5 mm
        last, gaps = [], []
        for k in np.unique(strip):
            along = np.sort(s[on][strip == k])
            if len(along) > 5:
                last.append(along[-1])
                gaps.append(np.median(np.diff(along[-6:])))
        if len(last) < 5:
            return float("nan"), float("nan")
        gap = float(np.median(gaps))
        spread = float(np.median(np.abs(np.array(last) - np.median(last)))) * 1.4826  # MAD to a deviation
        return float(np.median(last)), max(spread, gap)


@dataclass(frozen=True, eq=False)
class TipBall:
    """A ball of known radius m at a centre (3,) m, at the end of a rod that points along ``axis`` (3,)."""

    centre: Array
    radius: float
    axis: Array
    reach_m: float

    size: int = 3

    @property
    def middle(self) -> Array:
        """Its place (3,) m."""
        return self.centre

    @property
    def around_m(self) -> float:
        """Distance from its place beyond which no point can lie on it."""
        return self.reach_m + SPARE_M

    def near(self, p: Array) -> Flags:
        """Which points (N, 3) lie about the ball's free half."""
        v = p - self.centre
        return np.asarray((np.linalg.norm(v, axis=1) < self.reach_m) & (v @ self.axis > -_ABOVE * self.radius))

    def rows(self, p: Array) -> tuple[Array, Array, Array]:
        """Distances (N,) m of points (N, 3), outward normals (N, 3), derivatives (N, 3) of the distances."""
        v = p - self.centre
        d = np.maximum(np.linalg.norm(v, axis=1), 1e-9)
        n = v / d[:, None]
        return d - self.radius, n, -n

    def cells(self, p: Array) -> NDArray[np.int64]:
        """Return the cell (N, 2) of each point: an eighth of the ball's circle in each direction."""
        x, y, z = ((p - self.centre) @ frames_along(self.axis[None])[0]).T
        around = np.floor(np.arctan2(y, x) / (0.25 * np.pi))
        return np.column_stack([around, np.floor(np.arctan2(np.hypot(x, y), z) / (0.25 * np.pi))]).astype(np.int64)

    def prior(self) -> Array:
        """Return no rows: the points hold all of it."""
        return np.zeros((0, 3))

    def moved(self, x: Array) -> TipBall:
        """Return the ball after a shift (3,) m."""
        return replace(self, centre=self.centre + x)
