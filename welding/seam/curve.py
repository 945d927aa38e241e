"""A weld seam as an arc-length spline: position, tangent, normal, up-normal, curvature and projection."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform
from scipy.interpolate import CubicSpline, make_smoothing_spline

from weldcal.models.compiled import compiled
from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array

_REPEAT_M = 1e-6  # neighbours closer than a micrometre are the same point
_CLOSED_M, _SPREAD_M = 1e-3, 0.010  # between the ends of a ring, and over how much of it their difference is spread
_KNOT_M = 1e-3  # knots at most a millimetre apart: a 1 mm radius is still a curve


# Position m, unit tangent, normal and up, three numbers each, then the curvature 1/m.
FrameNumbers = tuple[float, float, float, float, float, float, float, float, float, float, float, float, float]


class SeamError(InputError):
    """The points do not make a seam."""


class TooFewSeamPoints(SeamError):
    """A cubic needs four points."""


class RepeatedSeamPoints(SeamError):
    """Neighbouring points coincide, so the seam has no direction there."""


class NonFiniteSeamPoints(SeamError):
    """A point or normal is not a number."""


def ringed(line: Array, ups: Array) -> tuple[Array, Array, float | None]:
    """A closed line (N,3) m and its ups, four times around, and the length m of one turn; any other as it is, and None.

    Where it was measured, its ends differ a little: the difference is spread over the line beside them.
    """
    apart = line[-1] - line[0]
    if np.linalg.norm(apart) > _CLOSED_M:
        return line, ups, None
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    share = np.maximum(1.0 - s / _SPREAD_M, 0.0) - np.maximum(1.0 - (s[-1] - s) / _SPREAD_M, 0.0)
    line = line + 0.5 * share[:, None] * apart
    return np.vstack([line, *[line[1:]] * 3]), np.vstack([ups, *[ups[1:]] * 3]), float(s[-1])


class SeamFrame(NamedTuple):
    """The seam at one arc length: position (3,) m, unit tangent, in-plane left normal and up (3,), curvature 1/m."""

    position: Array
    tangent: Array
    normal: Array
    up: Array
    curvature: float


@dataclass(frozen=True)
class SeamCurve:
    """An arc-length cubic spline of a seam in one frame, straight beyond both ends.

    The groove may be drawn on past a seam's end: beyond `length` the curve then follows it to the last knot, and is
    straight after it. Curvature is signed: positive where the seam turns towards its left normal (up x tangent).

    Attributes:
        knots: (n+1,) arc lengths in m, from 0 to `drawn_m`.
        coefficients: (n, 4, 3) cubic coefficients in m, highest power first, by distance past each knot.
        ups: (n+1, 3) up-normal at each knot, away from the work.
        end: arc length of the seam's end, m; None: the last knot.
    """

    knots: Array
    coefficients: Array
    ups: Array
    end: float | None = None

    @classmethod
    def from_points(
        cls,
        points: ArrayLike,
        up: ArrayLike = (0.0, 0.0, 1.0),
        smoothing: float | None = None,
        length: float | None = None,
    ) -> Self:
        """The curve through `points` (N,3) m, in the order of travel.

        Args:
            points: (N,3) in m.
            up: (3,), or (N,3) where the surface bends; need not be unit length.
            smoothing: None interpolates; a number is the penalty of a cubic smoothing spline over arc length, in m^3
                (features much shorter than its fourth root times the fourth root of the spacing are removed).
            length: where along the points the seam ends, m; None: at the last point.

        Raises:
            TooFewSeamPoints, RepeatedSeamPoints, NonFiniteSeamPoints, SeamError: what the points lack.
        """
        p = np.asarray(points, dtype=float)
        if p.ndim != 2 or p.shape[1] != 3:
            raise SeamError(f"A seam needs an (N, 3) array of points in metres; this one has shape {p.shape}.")
        if len(p) < 4:
            raise TooFewSeamPoints(f"A seam needs at least 4 points; {len(p)} were given.")
        b = np.broadcast_to(np.asarray(up, dtype=float), p.shape).copy()
        if not (np.isfinite(p).all() and np.isfinite(b).all()):
            raise NonFiniteSeamPoints("Remove the seam points or normals that are not finite numbers.")
        steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
        if (steps < _REPEAT_M).any():
            raise RepeatedSeamPoints(f"Remove the repeated seam point {int(np.argmin(steps)) + 1}.")
        lengths = np.linalg.norm(b, axis=1)
        if (lengths < 1e-9).any():
            raise SeamError("Every up-normal of a seam needs a direction; one has length zero.")
        b /= lengths[:, None]

        s = np.concatenate([[0.0], np.cumsum(steps)])
        end = None if length is None or length >= s[-1] else length
        if smoothing is not None and len(p) >= 5:
            p = np.column_stack([make_smoothing_spline(s, p[:, k], lam=smoothing)(s) for k in range(3)])
            before, s = s, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
            end = None if end is None else float(np.interp(end, before, s))
        # Twice: measure the arc length of the spline, place even knots, fit again; its speed is then 1 within 1e-4.
        for _ in range(2):
            curve = CubicSpline(s, np.column_stack([p, b]))
            fine = np.linspace(0.0, s[-1], 8 * max(len(s), math.ceil(s[-1] / _KNOT_M)) + 1)
            middle = 0.5 * (fine[1:] + fine[:-1])
            speed = np.linalg.norm(curve(middle, 1)[:, :3], axis=1)
            arc = np.concatenate([[0.0], np.cumsum(speed * np.diff(fine))])
            end = None if end is None else float(np.interp(end, fine, arc))
            n = max(len(s) - 1, math.ceil(arc[-1] / _KNOT_M), 3)
            s_even = np.linspace(0.0, arc[-1], n + 1)
            values = curve(np.interp(s_even, arc, fine))
            s, p, b = s_even, values[:, :3], values[:, 3:]
        b /= np.linalg.norm(b, axis=1, keepdims=True)
        coefficients = np.ascontiguousarray(np.transpose(CubicSpline(s, p).c, (1, 0, 2)))
        tangents = coefficients[:, 2]
        if (np.abs(np.einsum("ij,ij->i", tangents, b[:-1])) > 0.9).any():
            raise SeamError("The up-normal of a seam must be perpendicular to it; here it points along the seam.")
        return cls(s, coefficients, b, end)

    @property
    def length(self) -> float:
        """The seam's arc length in m."""
        return self.drawn_m if self.end is None else self.end

    @property
    def drawn_m(self) -> float:
        """The arc length in m up to which the groove is drawn.

        The seam's own, or more where the groove goes on past its end.
        """
        return float(self.knots[-1])

    def _pieces(self, s: Array) -> tuple[Array, Array, Array]:
        """(index, distance past the knot, distance past the nearer end) for each arc length."""
        inside = np.clip(s, 0.0, self.knots[-1])
        # The knots are even, so the piece is a division; the last knot belongs to the last piece.
        index = np.minimum((inside / self.knots[1]).astype(int), len(self.coefficients) - 1)
        return index, inside - self.knots[index], s - inside

    def position(self, s: ArrayLike) -> Array:
        """Points (...,3) m at arc lengths s (...) m; straight on beyond what is drawn."""
        index, x, beyond = self._pieces(np.asarray(s, dtype=float))
        c, x = self.coefficients[index], x[..., None]
        p = ((c[..., 0, :] * x + c[..., 1, :]) * x + c[..., 2, :]) * x + c[..., 3, :]
        return np.asarray(p + beyond[..., None] * self.tangent(s) if np.any(beyond) else p)

    def _derivative(self, s: ArrayLike) -> Array:
        index, x, _ = self._pieces(np.asarray(s, dtype=float))
        c, x = self.coefficients[index], x[..., None]
        return np.asarray((3.0 * c[..., 0, :] * x + 2.0 * c[..., 1, :]) * x + c[..., 2, :])

    def tangent(self, s: ArrayLike) -> Array:
        """Unit tangents (...,3) at arc lengths s (...) m."""
        d = self._derivative(s)
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def up(self, s: ArrayLike) -> Array:
        """Up-normals (...,3), square to the tangent, at arc lengths s (...) m."""
        index, x, _ = self._pieces(np.asarray(s, dtype=float))
        share = (x / self.knots[1])[..., None]
        b = self.ups[index] * (1.0 - share) + self.ups[index + 1] * share
        t = self.tangent(s)
        b = b - np.sum(b * t, axis=-1, keepdims=True) * t
        return np.asarray(b / np.linalg.norm(b, axis=-1, keepdims=True))

    def normal(self, s: ArrayLike) -> Array:
        """In-plane left normals (...,3), up x tangent, at arc lengths s (...) m."""
        return np.cross(self.up(s), self.tangent(s))

    def curvature(self, s: ArrayLike) -> Array:
        """Signed in-plane curvature (...) in 1/m, positive to the left; zero beyond what is drawn."""
        index, x, beyond = self._pieces(np.asarray(s, dtype=float))
        c = self.coefficients[index]
        second = 6.0 * c[..., 0, :] * x[..., None] + 2.0 * c[..., 1, :]
        bend = np.sum(second * self.normal(s), axis=-1)
        return np.asarray(np.where(beyond == 0.0, bend, 0.0))

    @cached_property
    def _rows(self) -> Array:
        """(n, 18), per piece.

        The cubic's 12 coefficients, highest power first, then the up-normals at its two knots.
        """
        return np.hstack([self.coefficients.reshape(len(self.coefficients), 12), self.ups[:-1], self.ups[1:]])

    @cached_property
    def _scale(self) -> tuple[float, float]:
        """(distance between knots, arc length drawn), m."""
        return float(self.knots[1]), float(self.knots[-1])

    def frame_numbers(self, s: float) -> FrameNumbers:
        """The seam's frame at one arc length s m as plain numbers: a third of the time of `frame`."""
        return _frame_numbers(self._rows, *self._scale, float(s))

    def frame(self, s: float) -> SeamFrame:
        """The seam's frame and curvature at one arc length s m, by a compiled loop, not by arrays of one row."""
        n = self.frame_numbers(s)
        return SeamFrame(np.array(n[0:3]), np.array(n[3:6]), np.array(n[6:9]), np.array(n[9:12]), n[12])

    def least_radius(self, s: float, within: float) -> float:
        """The least radius of curvature m in five places at most `within` m from an arc length s m; at most 1000 km."""
        return _least_radius(self._rows, *self._scale, float(s), float(within))

    def nearest(self, p: Array, s_near: float, window: float = 0.01) -> float:
        """The arc length m of the point nearest to p (3,) m, by Newton's steps from s_near, never `window` m away."""
        p0, p1, p2 = p.tolist()
        return _nearest(self._rows, *self._scale, p0, p1, p2, float(s_near), float(window))

    def project(self, p: ArrayLike, s_near: ArrayLike | None = None, window: float | None = None) -> Array:
        """Arc lengths (...) m of the seam points nearest to p (...,3) m.

        Args:
            p: (...,3) in m.
            s_near: (...) m, where to look; the whole seam and its straight extensions when None.
            window: how far from s_near to look, in m; everywhere when None.
        """
        q = np.asarray(p, dtype=float)
        centre = np.broadcast_to(0.5 * self.length if s_near is None else np.asarray(s_near, dtype=float), q.shape[:-1])
        reach = window if window is not None and s_near is not None else self.length + float(np.max(np.abs(centre)))
        n = max(5, min(2 * math.ceil(reach / (2.0 * _KNOT_M)) + 1, 2001))
        trial = centre[..., None] + np.linspace(-reach, reach, n)
        gaps = np.linalg.norm(q[..., None, :] - self.position(trial), axis=-1)
        s = np.take_along_axis(trial, np.argmin(gaps, axis=-1)[..., None], axis=-1)[..., 0]
        for _ in range(5):
            t = self.tangent(s)
            gap = q - self.position(s)
            slope = np.maximum(1.0 - np.sum(gap * self.normal(s), axis=-1) * self.curvature(s), 0.5)
            s = np.clip(s + np.sum(gap * t, axis=-1) / slope, centre - reach, centre + reach)
        return np.asarray(s)

    def transformed(self, X: RigidTransform) -> Self:
        """The same seam seen from another frame: X maps this curve's frame into that one."""
        R, p = X.rotation().matrix(), X.translation()
        coefficients = self.coefficients @ R.T
        coefficients[:, 3] += p
        return type(self)(self.knots, coefficients, self.ups @ R.T, self.end)

    def raised(self, height: float, left: float = 0.0) -> Self:
        """The line `height` m above this seam and `left` m to its left, by arc length of its own."""
        n = len(self.knots)
        s = self.knots
        points = self.position(s) + height * self.up(s) + left * self.normal(s)
        if n < 4:
            return self
        if self.end is None:
            return type(self).from_points(points, self.ups)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        length = float(np.interp(self.end, s, np.concatenate([[0.0], np.cumsum(steps)])))
        return type(self).from_points(points, self.ups, length=length)

    def __post_init__(self) -> None:
        for array in (self.knots, self.coefficients, self.ups):
            array.flags.writeable = False


@compiled()
def _frame_numbers(rows: Array, step: float, last: float, s: float) -> FrameNumbers:
    inside = 0.0 if s < 0.0 else last if s > last else s
    # Of an arc length that is not a number, so is the frame: its piece must exist all the same.
    i = max(0, min(int(inside / step), len(rows) - 1))
    x = inside - i * step
    ax, ay, az, bx, by, bz = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4], rows[i, 5]
    cx, cy, cz, px, py, pz = rows[i, 6], rows[i, 7], rows[i, 8], rows[i, 9], rows[i, 10], rows[i, 11]
    tx, ty = (3.0 * x * ax + 2.0 * bx) * x + cx, (3.0 * x * ay + 2.0 * by) * x + cy
    tz = (3.0 * x * az + 2.0 * bz) * x + cz
    size = math.sqrt(tx * tx + ty * ty + tz * tz)
    tx, ty, tz = tx / size, ty / size, tz / size
    px, py, pz = (
        ((ax * x + bx) * x + cx) * x + px,
        ((ay * x + by) * x + cy) * x + py,
        ((az * x + bz) * x + cz) * x + pz,
    )
    share = x / step
    rest = 1.0 - share
    ux, uy = rest * rows[i, 12] + share * rows[i, 15], rest * rows[i, 13] + share * rows[i, 16]
    uz = rest * rows[i, 14] + share * rows[i, 17]
    along = ux * tx + uy * ty + uz * tz
    ux, uy, uz = ux - along * tx, uy - along * ty, uz - along * tz
    size = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / size, uy / size, uz / size
    nx, ny, nz = uy * tz - uz * ty, uz * tx - ux * tz, ux * ty - uy * tx
    bend, beyond = 0.0, s - inside
    if beyond == 0.0:
        bend = (6.0 * x * ax + 2.0 * bx) * nx + (6.0 * x * ay + 2.0 * by) * ny + (6.0 * x * az + 2.0 * bz) * nz
    else:
        px, py, pz = px + beyond * tx, py + beyond * ty, pz + beyond * tz
    return px, py, pz, tx, ty, tz, nx, ny, nz, ux, uy, uz, bend


@compiled()
def _least_radius(rows: Array, step: float, last: float, s: float, within: float) -> float:
    most = 1e-6
    for k in (-1.0, -0.5, 0.0, 0.5, 1.0):
        most = max(most, abs(_frame_numbers(rows, step, last, s + k * within)[12]))
    return 1.0 / most


@compiled()
def _nearest(
    rows: Array, step: float, last: float, p0: float, p1: float, p2: float, s_near: float, window: float
) -> float:
    s = s_near
    for _ in range(3):
        inside = 0.0 if s < 0.0 else last if s > last else s
        i = max(0, min(int(inside / step), len(rows) - 1))
        x = inside - i * step
        ax, ay, az, bx, by, bz = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3], rows[i, 4], rows[i, 5]
        cx, cy, cz, px, py, pz = rows[i, 6], rows[i, 7], rows[i, 8], rows[i, 9], rows[i, 10], rows[i, 11]
        dx, dy = (3.0 * x * ax + 2.0 * bx) * x + cx, (3.0 * x * ay + 2.0 * by) * x + cy
        dz = (3.0 * x * az + 2.0 * bz) * x + cz
        gx, gy = p0 - ((ax * x + bx) * x + cx) * x - px, p1 - ((ay * x + by) * x + cy) * x - py
        gz = p2 - ((az * x + bz) * x + cz) * x - pz
        slope = dx * dx + dy * dy + dz * dz
        along = gx * dx + gy * dy + gz * dz
        if s == inside:
            # A bend towards p tighter than the distance would reverse Newton's step: keep half of the slope.
            bend = 6.0 * x * (gx * ax + gy * ay + gz * az) + 2.0 * (gx * bx + gy * by + gz * bz)
            slope = max(slope - bend, 0.5 * slope)
        step_s = along / slope - (s - inside)
        s = min(max(s + step_s, s_near - window), s_near + window)
        if abs(step_s) < 1e-8:
            break
    return s


def _load() -> None:
    """Load the machine code, for which no tick has time."""
    rows = np.ones((1, 18))
    _nearest(rows, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    _least_radius(rows, 1.0, 1.0, 0.0, 1.0)


_load()
