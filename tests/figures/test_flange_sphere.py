"""The sphere of Table 2 beside the flange: both are measured in one scan, and the sphere's calibration needs its place
on the flange."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.figures.flange.published.command import false_segmentations, sphere_calibration
from tests.worlds.flange_frames import P_FS, SphereScan, cell_scans
from weldcal.calibration.flange.observation import Observation

X_BC = RigidTransform(RollPitchYaw(np.pi, 0.1, -1.5), [-0.65, 0.1, 1.25])


def scans(n: int, noise_m: float = 0.0, p_FS: np.ndarray = P_FS) -> list[SphereScan]:
    """Exact poses before a scanner at X_BC."""
    rng = np.random.default_rng(3)
    out = []
    for k in range(n):
        R = RotationMatrix(RollPitchYaw(*rng.uniform(-0.5, 0.5, 3)))
        X_BF = RigidTransform(R, np.add([-0.65, 0.1, 0.5], rng.uniform(-0.15, 0.15, 3)))
        X_CF = X_BC.inverse() @ X_BF
        seen = Observation(f"s{k}", X_BF, X_CF.translation(), X_CF.rotation().matrix()[:, 2])
        out.append(SphereScan(seen, X_CF.multiply(p_FS) + noise_m * rng.normal(size=3), X_BF))
    return out


def test_the_place_of_the_sphere_on_the_flange_is_found_with_the_pose() -> None:
    elsewhere = np.add(P_FS, [2e-3, -1e-3, 1.5e-3])
    found = sphere_calibration(scans(8, p_FS=elsewhere))
    assert found.IsNearlyEqualTo(X_BC, 1e-6)


def test_four_pairs_of_a_sphere_know_less_than_sixteen() -> None:
    off = []
    for n in (4, 16):
        X = sphere_calibration(scans(n, 1e-4))
        off.append(np.linalg.norm(X.multiply([0.0, 0.0, 0.7]) - X_BC.multiply([0.0, 0.0, 0.7])))
    assert off[1] < off[0]


def test_one_scan_shows_both() -> None:
    (one,) = cell_scans(1, 0)
    apart = np.linalg.norm(one.sphere - one.flange.p_CR)
    assert apart == pytest.approx(np.linalg.norm(P_FS), abs=4e-3)  # mounted to a millimetre per axis


def test_three_false_segmentations_in_54_spoil_least_squares_and_are_named() -> None:
    found = false_segmentations([s.flange for s in scans(54)])
    assert found["false"] == found["named"] == 3
    assert found["named_wrongly"] == 0
    assert float(str(found["svd_mm"])) > 2.0
    assert float(str(found["robust_mm"])) < 0.01
