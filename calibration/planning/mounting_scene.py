"""The scene of a mounting as estimated: carriers of scanner and circle, and the bodies that may collide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from scipy.spatial.distance import cdist

from weldcal.calibration.geometry.se3 import IDENTITY
from weldcal.calibration.hand_eye.mountings import Mounting, TargetObservation, get_mounting, problem_of
from weldcal.calibration.hand_eye.problem import Problem, State
from weldcal.calibration.planning.clearance import LinkCapsule, Surroundings, arm_bodies, lowest_point, occludes
from weldcal.models.arms.kinematics import ArmModel, jacobian, link_frames
from weldcal.models.arrays import Array
from weldcal.models.scanners import ScannerPreset

BASE, FLANGE = 0, 6
"""Places in link_frames of what does not move, and of the flange."""
FOOT = ("eye_in_hand", "eye_on_arm_target_on_base")
"""Configurations with the circle of the base mounting as target; the others have a flange."""
SCANNER_BODY = (0.13, 0.06, -0.045)
"""A scanner that is carried, as a capsule: half its length along x of the camera, radius, and where it lies along z
(m)."""
# a choice: between the recorded arms (0.15 mm per axis) and nominal ones; stated sigmas scale with it
ARM_ERROR_M = 4e-4
"""Rms error of the flange's position that an arm with its maker's calibration usually has."""
LENGTH_M = 0.5  # a choice: about an upper arm (UR5e 0.43, UR10e 0.61); it divides the error of lengths and angles
"""A link's length error (m) over its angle error (rad)."""
_RING = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
_ALONG = np.linspace(0.0, 1.0, 9)[:, None]


@dataclass(frozen=True, eq=False)
class CarriedLink:
    """A link between base and scanner (``sign`` +1) or circle (-1): frames in B of the link before it and of itself.

    Its errors' size, and its joint's spread at a stop, rad.
    """

    X_before: RigidTransform
    X: RigidTransform
    sign: float
    error_rad: float
    spread_rad: float


@dataclass(frozen=True, eq=False, kw_only=True)
class MountingScene:
    """The estimated scene during planning.

    ``link``: place in link_frames of what carries the scanner (0 base, 6 flange), ``X_LC`` the scanner there. ``X_HR``:
    the circle on what carries it: in the base, on the flange, or on the second arm's flange. ``radius_m``: its outer
    edge. ``target_known``: the drawing of X_HR is believed. ``arm_error_m``: rms error of the flange's reported
    position. ``arm_2``, ``X_BD``, ``q_home_2``: the second arm of a co-manipulation.
    """

    configuration: str
    arm: ArmModel
    link: int
    X_LC: RigidTransform
    X_HR: RigidTransform
    radius_m: float
    scanner: ScannerPreset
    q_home: Array
    target_known: bool = True
    arm_2: ArmModel | None = None
    X_BD: RigidTransform | None = None
    q_home_2: Array | None = None
    surroundings: Surroundings = field(default_factory=Surroundings)
    arm_error_m: float = ARM_ERROR_M
    repeatability_m: float = 5e-5

    @cached_property
    def sizes(self) -> tuple[tuple[float, float], ...]:
        """Return, of each arm, the error (rad) of each angle of a link, and the spread (rad) of each joint at a stop.

        Such errors put the flange at home off by ``arm_error_m`` (rms), such spreads move it by ``repeatability_m``.
        """
        found = []
        for arm, q in ((self.arm, self.q_home), (self.arm_2, self.q_home_2)):
            if arm is not None and q is not None:
                frames = link_frames(arm, q)
                levers = [float(np.sum((frames[-1].translation() - X.translation()) ** 2)) for X in frames[:-1]]
                # two of the three angles move the flange by the lever, three lengths by themselves
                gain = float(np.sqrt(sum(2.0 * square + 3.0 * LENGTH_M**2 for square in levers)))
                found.append(
                    (self.arm_error_m / gain, self.repeatability_m / float(np.linalg.norm(jacobian(arm, q)[3:])))
                )
        return tuple(found)

    def carried(self, q: Array, q_2: Array | None) -> list[CarriedLink]:
        """Return the links whose errors move scanner or circle, but not both."""
        end = 0 if self.two or self.configuration in FOOT else FLANGE
        frames = self.frames(q)
        found = [(frames, k, float(k < self.link) - float(k < end), self.sizes[0]) for k in range(FLANGE)]
        if self.two and q_2 is not None:
            second = self.frames_2(q_2)
            found += [(second, k, -1.0, self.sizes[1]) for k in range(FLANGE)]
        return [CarriedLink(X[k], X[k + 1], sign, *size) for X, k, sign, size in found if sign]

    @property
    def mounting(self) -> Mounting:
        """The mounting of this configuration."""
        return get_mounting(self.configuration)

    @property
    def two(self) -> bool:
        """Whether there is a second arm."""
        return self.arm_2 is not None

    def believing(self, poses: dict[str, RigidTransform]) -> MountingScene:
        """Return the same scene with what a calibration found (letters X, Y, Z of the mounting's unknowns)."""
        found = replace(self, X_LC=poses.get("X", self.X_LC))
        if self.two:
            return replace(found, X_BD=poses.get("Y", self.X_BD), X_HR=poses.get("Z", self.X_HR))
        return replace(found, X_HR=poses.get("Y", self.X_HR))

    @property
    def known(self) -> dict[str, RigidTransform]:
        """The letters that are given rather than sought."""
        if not self.target_known:
            return {}
        return {"Z" if self.two else "Y": self.X_HR}

    @property
    def state(self) -> State:
        """The estimate as the solver's start."""
        X, target = np.asarray(self.X_LC.GetAsMatrix4()), np.asarray(self.X_HR.GetAsMatrix4())
        if self.X_BD is None:
            return X, target, IDENTITY
        return X, np.asarray(self.X_BD.GetAsMatrix4()), target

    def frames(self, q: Array) -> list[RigidTransform]:
        """Link frames of the first arm in B."""
        return link_frames(self.arm, q)

    def frames_2(self, q_2: Array) -> list[RigidTransform]:
        """Link frames of the second arm in B."""
        assert self.arm_2 is not None
        assert self.X_BD is not None
        return [self.X_BD @ X for X in link_frames(self.arm_2, q_2)]

    def seen(self, q: Array, q_2: Array | None = None) -> RigidTransform:
        """X_CR that is expected with the arms at q and q_2 (6,) rad."""
        frames = self.frames(q)
        return (frames[self.link] @ self.X_LC).InvertAndCompose(self.circle(frames, q_2))

    def circle(self, frames: list[RigidTransform], q_2: Array | None) -> RigidTransform:
        """X_BR, the circle in the base."""
        if self.two:
            assert q_2 is not None
            return self.frames_2(q_2)[FLANGE] @ self.X_HR
        return self.X_HR if self.configuration in FOOT else frames[FLANGE] @ self.X_HR

    def observation(
        self, q: Array, q_2: Array | None, p_CR: Array, n_CR: Array, covariance: Array | None = None
    ) -> TargetObservation:
        """Return the observation of a circle with the arms at q and q_2, as the solver takes it."""
        frames = self.frames(q)
        X_DE = None if self.arm_2 is None or q_2 is None else link_frames(self.arm_2, q_2)[FLANGE]
        X_BL = frames[self.link] if "arm" in self.configuration else None
        return TargetObservation(X_BF=frames[FLANGE], p_CM=p_CR, n_CM=n_CR, covariance=covariance, X_BL=X_BL, X_DE=X_DE)

    def problem(self, observations: Sequence[TargetObservation]) -> Problem:
        """Return the equation of some observations."""
        return problem_of(self.mounting, observations, self.known)


class Bodies:
    """Bodies that may collide or occlude: arms, the scanner where an arm carries it.

    Each capsule is nine points with a radius.
    """

    def __init__(self, scene: MountingScene) -> None:
        self.scene = scene
        self.arm = arm_bodies(scene.arm)
        self.arm_2 = [] if scene.arm_2 is None else arm_bodies(scene.arm_2)
        half, radius, z = SCANNER_BODY
        ends = [np.asarray(scene.X_LC @ np.array([side * half, 0.0, z])) for side in (-1.0, 1.0)]
        carried = scene.link != BASE
        self.scanner = [LinkCapsule(scene.link, scene.link, ends[0], ends[1], radius)] if carried else []
        first = [*self.arm, *self.scanner]
        self._first, self._second = _stack(first), _stack(self.arm_2)
        link = np.array([b.link for b in first])
        apart = np.abs(link[:, None] - link[None]) >= 3
        if carried:  # the scanner may meet all but its carrier, and the flange's neighbour that it hangs beside
            apart[-1, :-1] = np.abs(link[:-1] - scene.link) > (1 if scene.link == FLANGE else 0)
            apart[:, -1] = apart[-1]
            apart[-1, -1] = False
        r, r_2 = (np.array([b.radius for b in bodies]) for bodies in (first, self.arm_2))
        self._own = np.where(apart, r[:, None] + r[None], -np.inf)
        self._other = r[:, None] + r_2[None]

    def gap(self, frames: list[RigidTransform], frames_2: list[RigidTransform] | None) -> float:
        """Smallest distance (m) between bodies that can meet; the scanner's carrier and its neighbours do not count."""
        if self.scene.surroundings.touched([*self.arm, *self.scanner], frames):
            return -np.inf
        if frames_2 is not None and self.scene.surroundings.touched(self.arm_2, frames_2):
            return -np.inf
        here = _placed(self._first, frames)
        least = float((_distances(here, here) - self._own).min())
        if frames_2 is not None:
            there = _placed(self._second, frames_2)
            least = min(least, float((_distances(here, there) - self._other).min()))
        return least

    def lowest(self, frames: list[RigidTransform], frames_2: list[RigidTransform] | None) -> float:
        """Lowest point (m, in B) of what moves."""
        low = [lowest_point([*self.arm, *self.scanner], frames)]
        if frames_2 is not None:
            low.append(lowest_point(self.arm_2, frames_2))
        return min(low)

    def hidden(self, frames: list[RigidTransform], frames_2: list[RigidTransform] | None, X_BR: RigidTransform) -> bool:
        """Return whether a body is between scanner and circle (of a base circle: the half that is on its side)."""
        eye = np.asarray((frames[self.scene.link] @ self.scene.X_LC).translation())
        ring = self.scene.radius_m * np.column_stack([np.cos(_RING), np.sin(_RING), 0.0 * _RING])
        points = (X_BR @ ring.T).T
        if self.scene.configuration in FOOT:
            toward = eye - X_BR.translation()
            points = points[(points - X_BR.translation()) @ toward > -0.1 * self.scene.radius_m]
        carrier = self.scene.link
        mine = [b for b in self.arm if b.link != carrier or carrier == BASE]
        if occludes(mine, frames, eye, points, 0.01)[0]:
            return True
        return frames_2 is not None and occludes(self.arm_2, frames_2, eye, points, 0.01)[0]

    def clear(
        self, starts: tuple[Array, Array | None], ends: tuple[Array, Array | None], table_z_m: float, step_rad: float
    ) -> bool:
        """Test whether a move straight in the joints keeps off the table and of what may touch.

        Both arms move, or one of them rests.
        """
        (a, a_2), (b, b_2) = starts, ends
        far = float(np.abs(b - a).max())
        if a_2 is not None and b_2 is not None:
            far = max(far, float(np.abs(b_2 - a_2).max()))
        for u in np.linspace(0.0, 1.0, max(int(np.ceil(far / step_rad)) + 1, 2)):
            frames = self.scene.frames(a + u * (b - a))
            frames_2 = None if a_2 is None or b_2 is None else self.scene.frames_2(a_2 + u * (b_2 - a_2))
            if self.lowest(frames, frames_2) <= table_z_m or self.gap(frames, frames_2) <= 0.0:
                return False
        return True


Stacked = tuple[NDArray[np.intp], Array]
"""Frames (n,) and points in them (n, 9, 3) of n capsules."""


def _stack(bodies: Sequence[LinkCapsule]) -> Stacked:
    points = [b.p_start + _ALONG * (b.p_end - b.p_start) for b in bodies]
    return np.array([b.frame for b in bodies], dtype=np.intp), np.array(points).reshape(-1, len(_ALONG), 3)


def _placed(stacked: Stacked, frames: list[RigidTransform]) -> Array:
    X = np.array([f.GetAsMatrix34() for f in frames])[stacked[0]]
    return np.asarray(stacked[1] @ np.swapaxes(X[:, :, :3], 1, 2) + X[:, None, :, 3])


def _distances(a: Array, b: Array) -> Array:
    """Smallest distances (n, m) between the points of capsules."""
    flat = cdist(a.reshape(-1, 3), b.reshape(-1, 3))
    k = len(_ALONG)
    return np.asarray(flat.reshape(len(a), k, len(b), k).min(axis=(1, 3)))
