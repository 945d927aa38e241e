"""Seams of the weld study: straight, S, L corners, infeasible turns, and seams on a cylinder."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array

LENGTH_M = 0.300


class UnknownSeam(InputError):
    """No seam has this name."""


@dataclass(frozen=True)
class TrueSeam:
    """Root line of a groove as it really is: points (N,3) m in order of travel, and up-normals (3,) or (N,3)."""

    name: str
    points: Array
    up: Array


def arcs(*pieces: tuple[float, float], spacing: float = 1e-3) -> Array:
    """Points (N,3) m of a plane curve of (length m, curvature 1/m) pieces, from the origin along x.

    Left is positive.
    """
    points, heading, p = [np.zeros(3)], 0.0, np.zeros(3)
    for length, curvature in pieces:
        n = max(4, round(length / spacing))
        for _ in range(n):
            turn = curvature * length / n
            chord = length / n * np.sinc(0.5 * turn / np.pi)
            middle = heading + 0.5 * turn
            p = p + chord * np.array([math.cos(middle), math.sin(middle), 0.0])
            heading += turn
            points.append(p)
    return np.array(points)


def corner(radius: float, turn_deg: float, side: float, legs: float | None = None, spacing: float = 1e-3) -> Array:
    """Two straights and a turn between them; `side` +1 turns left. Legs as long as makes 300 mm in all unless given."""
    turn = math.radians(turn_deg)
    leg = 0.5 * (LENGTH_M - radius * turn) if legs is None else legs
    return arcs((leg, 0.0), (radius * turn, side / radius), (leg, 0.0), spacing=min(spacing, 0.2 * radius))


def s_curve(radius: float = 0.060, turn: float = math.radians(60.0)) -> Array:
    """Return an S of 300 mm: straight, left, right, left, right, straight."""
    bend = radius * turn
    rest = 0.5 * (LENGTH_M - 3.0 * bend)
    k = 1.0 / radius
    return arcs((rest, 0.0), (0.5 * bend, k), (bend, -k), (bend, k), (0.5 * bend, -k), (rest, 0.0))


def on_cylinder(flat: Array, radius: float) -> tuple[Array, Array]:
    """Return a flat curve (N,3) wrapped on a cylinder of that radius m with its axis along y, and the normals (N,3)."""
    a = (flat[:, 0] - flat[:, 0].mean()) / radius
    up = np.column_stack([np.sin(a), 0.0 * a, np.cos(a)])
    return np.column_stack([radius * np.sin(a), flat[:, 1], radius * np.cos(a) - radius]), up


def _cusp(radius: float = 0.020) -> Array:
    """Two arcs of opposite turn that meet in a point: the tangent reverses there."""
    a = np.linspace(0.5 * math.pi, 0.0, 60)
    first = radius * np.column_stack([np.cos(a), np.sin(a), 0.0 * a])
    leg = np.column_stack([np.linspace(-0.1, -0.001, 80), np.full(80, radius), np.zeros(80)])
    # Mirrored in the tip, so that both branches are tangent to the same line there.
    second = np.column_stack([2.0 * radius - first[::-1, 0], first[::-1, 1], first[::-1, 2]])
    out = np.column_stack(
        [np.linspace(2.0 * radius + 0.001, 2.0 * radius + 0.1, 80), np.full(80, radius), np.zeros(80)]
    )
    return np.vstack([leg, first, second[1:], out])


_FLAT: dict[str, Callable[[], Array]] = {
    "straight": lambda: arcs((LENGTH_M, 0.0), spacing=2e-3),
    "s_r60": s_curve,
    "l_r20_convex": lambda: corner(0.020, 90.0, 1.0),
    "l_r20_concave": lambda: corner(0.020, 90.0, -1.0),
    "l_r5_convex": lambda: corner(0.005, 90.0, 1.0),
    "l_r5_concave": lambda: corner(0.005, 90.0, -1.0),
    "l_r1_convex": lambda: corner(0.001, 90.0, 1.0),
    "l_r1_concave": lambda: corner(0.001, 90.0, -1.0),
    "arc_r60_end": lambda: arcs((LENGTH_M - 0.060 * 1.5, 0.0), (0.060 * 1.5, 1.0 / 0.060)),
    "turn_120_r20": lambda: corner(0.020, 120.0, 1.0, 0.12),
    "turn_120_r5": lambda: corner(0.005, 120.0, -1.0, 0.12),
    "turn_150_r10": lambda: corner(0.010, 150.0, 1.0, 0.12),
    "u_r20": lambda: corner(0.020, 180.0, 1.0, 0.12),
    "u_r30": lambda: corner(0.030, 180.0, -1.0, 0.12),
    "u_r100": lambda: corner(0.100, 180.0, 1.0, 0.06),
    "cusp_r20": _cusp,
}
NAMES = (*_FLAT, "s_r60_on_r300", "s_r60_on_r150", "l_r20_on_r300", "l_r20_on_r150")


def get_seam(name: str) -> TrueSeam:
    """Return the seam of that name; `<flat>_on_r<mm>` is a flat one wrapped on a cylinder. Left turns are convex.

    The tip leans on the wall to its left, as in the paper: a left turn leads round the outside of that wall's corner.

    Raises:
        UnknownSeam: naming the known ones.
    """
    if name not in NAMES:
        raise UnknownSeam(f"Unknown seam '{name}'; use one of {', '.join(NAMES)}.")
    flat, _, radius = name.partition("_on_r")
    if radius:
        points = _FLAT["l_r20_convex" if flat == "l_r20" else flat]()
        wrapped, up = on_cylinder(points, 1e-3 * float(radius))
        return TrueSeam(name, wrapped, up)
    return TrueSeam(name, _FLAT[name](), np.array([0.0, 0.0, 1.0]))
