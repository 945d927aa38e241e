"""Six to twelve scans of a sphere: the one pose that they show, an honest covariance, or a refusal."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.calibration.profiler.test_exports import P_FS, R_FS, RADIUS, World, quaternions, world
from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.calibration.errors import DegenerateMotion
from weldcal.calibration.profiler.edge.features import robust_line
from weldcal.calibration.profiler.importing import import_profiles
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.reading_choice import choose_reading, sphere_fit
from weldcal.calibration.profiler.result import believed_covariance
from weldcal.calibration.profiler.sphere.joint import SphereEstimate, sphere_joint
from weldcal.calibration.profiler.sphere.model import SphereData
from weldcal.models.errors import InputError


def measured(w: World) -> SphereData:
    profiles = [1e-3 * np.column_stack([w.x, z])[np.isfinite(z)] for z in w.z]
    return SphereData(poses=FlangePoses(w.R.as_matrix(), 1e-3 * w.p), profiles=profiles, radius_m=1e-3 * RADIUS)


def nees(e: SphereEstimate) -> float:
    """Squared error of X_FS in its stated sigmas: chi-square with 6 degrees where these are right."""
    turn = (Rotation.from_matrix(e.rotation) * R_FS.inv()).as_rotvec()
    error = np.concatenate([turn, e.translation - 1e-3 * P_FS])
    return float(error @ np.linalg.solve(believed_covariance(e), error))


@pytest.mark.parametrize(
    ("scans", "seeds"), [(6, (31, 51)), (7, (2, 41)), (8, (35, 50)), (9, (3, 31, 33)), (12, (51, 53))]
)
def test_few_scans_give_the_best_of_all_optima(scans: int, seeds: tuple[int, ...]) -> None:
    for seed in seeds:
        e = sphere_joint(measured(world(seed, scans=scans)), "rigid")
        assert nees(e) < 31.0  # chance 2.5e-5
        assert np.degrees((Rotation.from_matrix(e.rotation) * R_FS.inv()).magnitude()) < 2.0


@pytest.mark.parametrize("seed", [8, 25, 31])
def test_two_mountings_alike_under_noise_are_refused(seed: int) -> None:
    with pytest.raises(DegenerateMotion, match="Two mountings"):
        sphere_joint(measured(world(seed, scans=6, noise_mm=0.3)), "rigid")


def test_one_displaced_scan_of_few_widens_the_covariance() -> None:
    found = []
    for seed in range(12):
        data = measured(world(seed, scans=7))
        p = data.poses.translation.copy()
        p[seed % 7] += 2e-3
        try:
            found.append(nees(sphere_joint(replace(data, poses=FlangePoses(data.poses.rotation, p)), "rigid")))
        except DegenerateMotion:
            continue
    assert len(found) >= 6
    assert max(found) < 400.0  # and up to 5,589 by the chi-square of all points, which hides the scan


def test_one_axis_is_no_evidence_against_a_reading() -> None:
    w = world(scans=12, axis=(0.48, 0.6, 0.64))
    right = np.tile(np.eye(4), (12, 1, 1))
    right[:, :3, :3], right[:, :3, 3] = w.R.as_matrix(), 1e-3 * w.p
    wrong = right.copy()
    wrong[:, :3, :3] = Rotation.from_euler("XYZ", w.R.as_euler("xyz")).as_matrix()
    readings = [PoseReading(form, form, X) for X, form in ((wrong, "euler_XYZ"), (right, "euler_xyz"))]
    data = measured(w)
    with pytest.raises(DegenerateMotion, match="two different axes"):
        sphere_joint(data, "rigid")
    k, _ = choose_reading(readings, sphere_fit(data.profiles, data.radius_m), "sphere")
    assert readings[k].form == "euler_xyz"


def test_a_table_with_blanks_in_one_line_is_one_profile(tmp_path: Path) -> None:
    w = world()
    for k, z in enumerate(w.z):
        rows = [f"{a:.4f}\t{-10000.0 if np.isnan(v) else v:.4f}" for a, v in zip(w.x, z, strict=True)]
        rows[5] = rows[5].replace("\t", "  ")
        name = "scan.txt" if k == 0 else f"scan ({k}).txt"  # as copies are named
        (tmp_path / name).write_text("\n".join(rows) + "\n")
    with pytest.raises(InputError, match=f"holds {len(w.p)} profiles of {len(w.x)} points and no flange pose"):
        import_profiles(tmp_path)
    (tmp_path / "poses.csv").write_text(quaternions(w))
    found = import_profiles(tmp_path)
    assert found.profiles is not None
    assert [np.isfinite(p).all(axis=1).sum() for p in found.profiles] == [np.isfinite(z).sum() for z in w.z]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_flank_of_points_above_each_other_has_a_slope() -> None:
    x = np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0])
    a, b, _, _ = robust_line(x, 2.0 + 0.5 * x)
    assert (a, b) == (pytest.approx(2.0), pytest.approx(0.5))
