"""Kinematic errors of an arm: joint offsets, sag, lengths and twists, and their effect on the flange pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.models.arms.dh import dh_frames
from weldcal.models.errors import InputError

# Joint 1 turns the base and joint 6 the flange: their offsets are part of other unknowns.
OFFSET_JOINTS = (1, 2, 3, 4)
SAG_JOINTS = (1, 2)
TABLE = (0, 1, 2)  # columns of the table that may be off beside the joints' offsets: a, alpha, d
ARM_ERRORS = len(OFFSET_JOINTS) + len(SAG_JOINTS) + 6 * len(TABLE)


@dataclass(frozen=True, eq=False)
class ProfilerArmErrors:
    """Offsets (4,) rad of joints 2 to 5, sag (2,) rad/m of joints 2 and 3, and the table's errors (6, 3).

    ``a`` in m, ``alpha`` in rad, ``d`` in m.
    """

    offsets: Floats
    sag: Floats
    table: Floats

    @staticmethod
    def of(values: Floats) -> ProfilerArmErrors:
        """From a vector (24,) in this order."""
        k = len(OFFSET_JOINTS)
        m = k + len(SAG_JOINTS)
        return ProfilerArmErrors(values[:k], values[k:m], values[m:].reshape(6, 3))

    @property
    def values(self) -> Floats:
        """The vector (24,)."""
        return np.concatenate([self.offsets, self.sag, self.table.ravel()])

    @staticmethod
    def none() -> ProfilerArmErrors:
        """Return an arm as drawn."""
        return ProfilerArmErrors.of(np.zeros(ARM_ERRORS))


@dataclass(frozen=True, eq=False)
class DhArm:
    """A six-axis arm by standard Denavit-Hartenberg rows (6, 4): a m, alpha rad, d m, theta offset rad.

    Base z upwards.
    """

    rows: Floats

    @staticmethod
    def checked(rows: ArrayLike) -> DhArm:
        """Rows that are an arm.

        Raises:
            InputError: not (6, 4), or not finite.
        """
        dh = np.asarray(rows, float)
        if dh.shape != (6, 4) or not np.isfinite(dh).all():
            raise InputError(f"An arm's table has six finite rows [a, alpha, d, theta], not the shape {dh.shape}.")
        return DhArm(dh)

    def frames(self, q: Floats) -> Floats:
        """Homogeneous poses (n, 7, 4, 4) of the base and of the frames after each joint, for joints (n, 6) rad."""
        return dh_frames(self.rows, q)

    def loads(self, q: Floats) -> Floats:
        """Horizontal lever (n, 2) m of the flange about the axes of joints 2 and 3.

        What gravity turns them by, but for a factor.
        """
        frames = self.frames(q)
        flange = frames[:, 6, :2, 3]
        radial = flange / np.maximum(np.linalg.norm(flange, axis=1, keepdims=True), 1e-9)
        return np.column_stack([np.einsum("ni,ni->n", flange - frames[:, k, :2, 3], radial) for k in SAG_JOINTS])

    def poses(self, q: Floats, offsets: Floats, sag: Floats, loads: Floats) -> FlangePoses:
        """Flange poses with offsets (4,) rad of joints 2 to 5 and sag (2,) rad/m of joints 2 and 3."""
        X = self.frames(_moved(q, offsets, sag, loads))[:, 6]
        return FlangePoses(X[:, :3, :3], X[:, :3, 3])

    def changed(self, table: Floats) -> DhArm:
        """Return the same with errors (6, 3) of a, alpha and d added."""
        rows = np.array(self.rows)
        rows[:, TABLE] += table
        return DhArm(rows)

    def with_errors(self, q: Floats, errors: ProfilerArmErrors, loads: Floats) -> FlangePoses:
        """Flange poses of the arm with its errors."""
        return self.changed(errors.table).poses(q, errors.offsets, errors.sag, loads)

    def twists(self, q: Floats, errors: ProfilerArmErrors, loads: Floats) -> tuple[Floats, Floats]:
        """How the flange moves with each error.

        Turns w (n, 24, 3) and shifts v (n, 24, 3) with dp = w x p + v for p in B.

        An offset turns all beyond it about the joint's axis, d shifts it along that axis; a shifts along, and alpha
        turns about, the x axis of the frame after the joint.
        """
        moved = _moved(q, errors.offsets, errors.sag, loads)
        X = self.changed(errors.table).frames(moved)
        z, x, o = X[:, :6, :3, 2], X[:, 1:, :3, 0], X[:, :, :3, 3]
        zero = np.zeros_like(z)
        about_z = z, np.cross(o[:, :6], z)
        about_x = x, np.cross(o[:, 1:], x)
        table_w = np.stack([zero, about_x[0], zero], axis=2).reshape(len(q), 18, 3)
        table_v = np.stack([x, about_x[1], z], axis=2).reshape(len(q), 18, 3)
        off, sag = list(OFFSET_JOINTS), list(SAG_JOINTS)
        w, v = (
            np.concatenate([part[:, off], loads[:, :, None] * part[:, sag], table], axis=1)
            for part, table in zip(about_z, (table_w, table_v), strict=True)
        )
        return w, v


def _moved(q: Floats, offsets: Floats, sag: Floats, loads: Floats) -> Floats:
    """Joints (n, 6) as they are."""
    moved = np.array(q, float)
    moved[:, list(OFFSET_JOINTS)] += offsets
    moved[:, list(SAG_JOINTS)] += loads * sag
    return moved
