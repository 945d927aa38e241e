"""Injected faults beyond the twelve causes: other mistakes of a laboratory, some of which no model of the doctor describes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.doctor.case import Case
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.models.arms.chain import chain_poses
from weldcal.tools.studies.doctor.world import clean, make_world, observe, true_poses


def _inverted(seed: int) -> Case:
    case = clean(seed)
    return case.with_poses(inverse(case.X_BF))


def _euler(seed: int) -> Case:
    case = clean(seed)
    angles = Rotation.from_matrix(case.X_BF[:, :3, :3]).as_euler("ZYX")
    return case.with_poses(pose(Rotation.from_euler("xyz", angles).as_matrix(), case.X_BF[:, :3, 3]))


def _shifted(seed: int) -> Case:
    case = clean(seed)
    return case.pick(np.arange(1, case.n)).with_poses(case.X_BF[:-1])


def _mirrored(seed: int) -> Case:
    case = clean(seed)
    flip = np.array([1.0, -1.0, 1.0])
    return replace(case, c=case.c * flip, m=case.m * flip)


def _scale(seed: int) -> Case:
    case = clean(seed)
    return replace(case, c=case.c * (1.03 if seed % 2 else 0.97))


def _encoder(seed: int) -> Case:
    world = make_world(seed)
    q = world.q.copy()
    q[:, 1 + seed % 4] += np.radians(2.5)
    return observe(world, true_poses(world), believed=chain_poses(world.believed, q))


def _shuffled(seed: int) -> Case:
    case = clean(seed)
    return case.with_poses(case.X_BF[np.random.default_rng([seed, 11]).permutation(case.n)])


def _random_turns(seed: int) -> Case:
    case = clean(seed)
    R = Rotation.random(case.n, random_state=seed).as_matrix()
    return case.with_poses(pose(R, case.X_BF[:, :3, 3]))


UNKNOWN: dict[str, Callable[[int], Case]] = {
    "poses inverted": _inverted,
    "wrong rotation convention": _euler,
    "scans and poses shifted by one": _shifted,
    "scanner axes mirrored": _mirrored,
    "scanner scale error": _scale,
    "joint zero off by 2.5 degrees": _encoder,
    "scans of other poses": _shuffled,
    "rotations without meaning": _random_turns,
}
"""What each does to a set, by seed. Of the last three no model has the name: "unexplained", or a kinematics file, is right."""
