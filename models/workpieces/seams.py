"""A seam as drawn: its root line with the joint's walls on both sides, in the frame of the part."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from pydrake.math import RigidTransform

from weldcal.models.errors import InputError

Floats = npt.NDArray[np.float64]

JOINTS = ("v_groove", "butt", "fillet", "lap")
SPACING_M = 0.0005


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnSeam:
    """A seam in frame P (or another, see `transformed`), metres and unit vectors; N >= 4 points in the order of travel.

    Attributes:
        points_P: (N,3) the root line, evenly spaced (0.5 mm): where the two walls meet; of a butt joint with a gap the
            middle of the gap, level with the plates' faces.
        up_P: (N,3) the bisector of the walls, out of the joint towards the tool.
        wall_left_P, wall_right_P: (N,3) outward normals of the walls on the left and on the right of the travel
            direction; of a butt joint with a gap the normal of the plates' faces.
        joint: v_groove, butt, fillet or lap.
        wall_height_m: (left, right) usable extent of each wall, from the root line; of a butt joint with a gap the
            gap's depth.
        gap_m: width of the gap of a butt joint, else 0.
        closed: the last point continues into the first.
        feel: whether the tip feels it; None: where a ball can.
    """

    points_P: Floats
    up_P: Floats
    wall_left_P: Floats
    wall_right_P: Floats
    joint: str
    wall_height_m: Floats
    gap_m: float = 0.0
    closed: bool = False
    feel: bool | None = None
    listed: int = 0  # its number among the scenario's seams, of which one may have several legs

    def __post_init__(self) -> None:
        n = len(self.points_P)
        for name in ("points_P", "up_P", "wall_left_P", "wall_right_P"):
            value = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if value.shape != (n, 3) or not np.isfinite(value).all():
                raise InputError(f"A seam's {name} must be {n} rows of three finite numbers.")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        height = np.asarray(self.wall_height_m, dtype=np.float64).reshape(2)
        height.setflags(write=False)
        object.__setattr__(self, "wall_height_m", height)
        if n < 4:
            raise InputError(f"A seam needs at least four points, and this one has {n}.")
        if self.joint not in JOINTS:
            raise InputError(f"A joint must be one of {', '.join(JOINTS)}, not '{self.joint}'.")

    @cached_property
    def tangents_P(self) -> Floats:
        """(N,3) unit direction of travel."""
        t = np.gradient(self.points_P, axis=0)
        if self.closed:
            t[0] = t[-1] = self.points_P[1] - self.points_P[-2]
        return np.asarray(t / np.linalg.norm(t, axis=1, keepdims=True))

    @cached_property
    def left_P(self) -> Floats:
        """(N,3) unit vector to the left of the travel, square to the bisector."""
        left = np.cross(self.up_P, self.tangents_P)
        return np.asarray(left / np.linalg.norm(left, axis=1, keepdims=True))

    @cached_property
    def arc_length_m(self) -> Floats:
        """(N,) arc length from the first point, m."""
        steps = np.linalg.norm(np.diff(self.points_P, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length_m(self) -> float:
        """Arc length of the whole seam, m."""
        return float(self.arc_length_m[-1])

    @cached_property
    def opening_rad(self) -> Floats:
        """(N,) angle of the free space between the walls; 0 where they face each other, pi where they are one plane."""
        cos = np.clip(np.sum(self.wall_left_P * self.wall_right_P, axis=1), -1.0, 1.0)
        return np.asarray(np.pi - np.arccos(cos))

    def transformed(self, X: RigidTransform) -> DrawnSeam:
        """Return the same seam expressed through X (of P into B for X = X_BP)."""
        R = X.rotation().matrix()
        return replace(
            self,
            points_P=self.points_P @ R.T + X.translation(),
            up_P=self.up_P @ R.T,
            wall_left_P=self.wall_left_P @ R.T,
            wall_right_P=self.wall_right_P @ R.T,
        )

    def between(self, start_m: float, end_m: float) -> DrawnSeam:
        """Return the stretch between two arc lengths, m; a closed seam goes on beyond its end, over its start.

        Raises:
            InputError: less than four points are left.
        """
        s, rows = self.arc_length_m, np.arange(len(self.points_P))
        if self.closed and end_m > self.length_m:
            s, rows = np.concatenate([s, s[-1] + s[1:]]), np.concatenate([rows, rows[1:]])
        keep = (s >= start_m - 1e-9) & (s <= end_m + 1e-9)
        if keep.sum() < 4:
            raise InputError(
                f"Nothing is left of a seam of {1e3 * self.length_m:.1f} mm between {1e3 * start_m:.1f} and"
                f" {1e3 * end_m:.1f} mm."
            )
        whole, rows = bool(keep.all()), rows[keep]
        return replace(
            self,
            points_P=self.points_P[rows],
            up_P=self.up_P[rows],
            wall_left_P=self.wall_left_P[rows],
            wall_right_P=self.wall_right_P[rows],
            closed=self.closed and whole,
        )

    def reversed(self) -> DrawnSeam:
        """Return the same seam in the opposite direction: left and right change places."""
        return replace(
            self,
            points_P=self.points_P[::-1],
            up_P=self.up_P[::-1],
            wall_left_P=self.wall_right_P[::-1],
            wall_right_P=self.wall_left_P[::-1],
            wall_height_m=self.wall_height_m[::-1],
        )
