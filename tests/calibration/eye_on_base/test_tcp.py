"""A TCP that was set is found where the poses show it, and named no more often than said where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from tests.calibration.eye_on_base.test_solve import X_BC, displaced, make_observations
from tests.places import SHARED_DATA, needs
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import InconsistentPoses
from weldcal.calibration.eye_on_base.tcp import FALSE_ALARM, find_tcp
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.geometry.se3 import exp_rotation, skew
from weldcal.tools.recorded import calibrate_dataset


def with_tcp(observations: list[Observation], tcp_m: list[float]) -> list[Observation]:
    """The same scans, recorded with poses of a TCP on the flange."""
    return [replace(o, X_BR=o.X_BR @ RigidTransform(tcp_m)) for o in observations]


@pytest.mark.parametrize("tcp_m", [[0.0, 0.0, 0.15], [0.02, -0.03, 0.004], [0.0, 0.0, 0.005], [0.12, 0.0, 0.25]])
@pytest.mark.parametrize("n", [8, 15])
def test_a_tcp_is_found_to_its_sigma(tcp_m: list[float], n: int) -> None:
    found = find_tcp(with_tcp(make_observations(n, 3, turn=0.5), tcp_m))
    assert found is not None
    assert found.known.all()
    # six joint normals: one in a hundred thousand is farther off than 5.1
    assert (np.abs(found.offset_m + tcp_m) < 5.1 * found.sigma_m).all()
    assert found.sigma_m.max() < 3e-3
    # what an arm may pretend on eight poses is some 5 mm
    assert found.surely_beyond(0.0315) == (np.linalg.norm(tcp_m) > 0.04)
    assert found.pretended_m.max() < 6e-3


def test_the_sentence_gives_the_line_that_cures_it() -> None:
    tcp = RigidTransform([0.0, 0.0, 0.150])
    found = find_tcp(with_tcp(make_observations(12, 4, sigma=1e-6), [0.0, 0.0, 0.150]))
    assert found is not None
    sentence = found.sentence(RigidTransform())
    assert "TCP of (" in sentence
    assert "150.0) mm" in sentence
    assert "write poses: {tcp: [0.0000, 0.0000, 0.1500, 0.0, 0.0, 0.0]} (m, rad) in dataset.yaml" in sentence
    # a feature stays as it is: where it lies is nothing to the TCP, how it is turned is
    shifted = RigidTransform([0.14, 0.0, -0.012])
    assert found.sentence(shifted) == sentence
    turned = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.14, 0.0, -0.012])
    assert "{tcp: [0.0000, 0.0000, -0.1500, 0.0, 0.0, 0.0]}" in found.sentence(turned)
    assert "pairs.csv" in found.sentence(None)
    assert tcp.translation()[2] == pytest.approx(-found.offset_m[2], abs=1e-4)


def test_without_a_tcp_none_is_named() -> None:
    """The test's own false alarms alone would be one in a thousand; of 200 more than three are one chance in 10^5."""
    named = [seed for seed in range(200) if find_tcp(make_observations(6 + seed % 12, seed, turn=0.3)) is not None]
    assert FALSE_ALARM * 200 < 1
    assert len(named) <= 3


def facing(n: int, seed: int) -> list[Observation]:
    """Poses that face the scanner to within 9 degrees, as planned ones do: an error along its rays is one along their
    z."""
    rng = np.random.default_rng(seed)
    out = []
    for o in make_observations(n, seed):
        ray = o.p_CR / np.linalg.norm(o.p_CR)
        z = -ray
        x = np.cross([0.0, 1.0, 0.0], z)
        R = np.column_stack([x / np.linalg.norm(x), np.cross(z, x / np.linalg.norm(x)), z])
        R = R @ exp_rotation(rng.uniform(-0.15, 0.15, 3))
        out.append(replace(o, X_BR=RigidTransform(X_BC.rotation() @ RotationMatrix(R), o.p_BR), n_C=R[:, 2]))
    return out


def test_a_scanners_own_error_is_not_called_a_tcp() -> None:
    """A range that is 6 mm too long, as of time of flight, and scale with gradient: both lie along the poses' z."""
    scanner = ScannerCorrection(0.997, (0.02, -0.015))
    for seed in range(30):
        seen = facing(20, seed)
        far = [replace(o, p_CR=o.p_CR * (1.0 + 6e-3 / float(np.linalg.norm(o.p_CR)))) for o in seen]
        assert find_tcp(far) is None
        assert find_tcp([replace(o, p_CR=scanner.points(o.p_CR)) for o in seen]) is None


def test_what_an_arm_is_off_is_not_called_a_tcp() -> None:
    """Errors of 0.45 mm a coordinate that are spread over the poses as an offset along z would be, as far as no shift
    and no turn of the camera takes them up: nothing that an arm may be off looks more like a TCP."""
    for seed in range(10):
        poses = make_observations(12, seed, sigma=2e-5, turn=0.15)
        p = np.array([o.p_BR for o in poses])
        pose = np.concatenate([-skew(p - p.mean(axis=0)), np.broadcast_to(np.eye(3), (12, 3, 3))], axis=2).reshape(
            36, 6
        )
        z = np.array([o.X_BR.rotation().matrix()[:, 2] for o in poses]).ravel()
        z = z - pose @ np.linalg.lstsq(pose, z, rcond=None)[0]
        error = (4.5e-4 * 6.0 * z / np.linalg.norm(z)).reshape(12, 3)
        assert np.sqrt((error**2).mean()) == pytest.approx(4.5e-4)
        off = [
            replace(o, X_BR=RigidTransform(o.X_BR.rotation(), o.p_BR + e)) for o, e in zip(poses, error, strict=True)
        ]  # fmt: skip
        assert find_tcp(off) is None


@needs(SHARED_DATA / "flange")
@pytest.mark.parametrize("name", ["ur10e_phoxi_m", "ur10e_azure_kinect"])
def test_on_real_pairs_no_tcp_is_named_and_one_that_was_set_is(name: str) -> None:
    pairs = load_dataset(SHARED_DATA / "flange" / name).pairs
    seen = [Observation(p.id, p.X_BR, p.p_CR) for p in pairs]
    assert find_tcp(seen) is None
    found = find_tcp(with_tcp(seen, [0.0, 0.05, 0.18]))
    if name == "ur10e_phoxi_m":
        assert found is not None
        assert found.known.all()
        np.testing.assert_allclose(found.offset_m, [0.0, -0.05, -0.18], atol=3e-3)
        assert found.surely_beyond(0.0315)


def test_poses_of_one_orientation_show_none() -> None:
    assert find_tcp(with_tcp(make_observations(12, 5, turn=0.0), [0.0, 0.0, 0.15])) is None


def test_a_tcp_is_found_beside_outliers() -> None:
    observations = with_tcp(make_observations(15, 6, turn=0.5), [0.0, 0.03, 0.12])
    for k in (2, 9):
        observations[k] = displaced(observations[k], np.array([0.05, -0.02, 0.03]))
    found = find_tcp(observations)
    assert found is not None
    np.testing.assert_allclose(found.offset_m, [0.0, -0.03, -0.12], atol=2e-3)


def _pairs(folder: Path, observations: list[Observation]) -> Path:
    folder.mkdir()
    (folder / "dataset.yaml").write_text(
        "schema: 1\nrobot: ur10e\nflange: iso9409-1-50-4-m6\nscanner: any\nconfiguration: eye_on_base\nunits: {clouds:"
        " m, poses: m}\n"
    )
    rows = [
        [o.id, *o.p_BR, *o.p_CR, *o.X_BR.rotation().ToQuaternion().wxyz()] for o in observations
    ]  # fmt: skip
    header = "id,base_x,base_y,base_z,camera_x,camera_y,camera_z,base_qw,base_qx,base_qy,base_qz"
    (folder / "pairs.csv").write_text("\n".join([header, *(",".join(map(str, r)) for r in rows)]) + "\n")
    return folder


def test_calibrate_refuses_a_tcp_longer_than_the_flange_and_warns_of_a_shorter_one(tmp_path: Path) -> None:
    poses = make_observations(12, 7, turn=0.4, normals=False)
    for tcp_m in (0.15, 0.06):
        data = _pairs(tmp_path / f"long{tcp_m}", with_tcp(poses, [0.0, 0.0, tcp_m]))
        with pytest.raises(
            InconsistentPoses, match=rf"TCP of \(-?0\.\d, -?0\.\d, {1e3 * tcp_m - 1:.0f}\.\d|{1e3 * tcp_m:.0f}\.\d\) mm"
        ):
            calibrate_dataset(data, tmp_path / "none")
        assert [path.name for path in (tmp_path / "none").iterdir()] == ["observations.csv"]  # for the doctor
    short = calibrate_dataset(_pairs(tmp_path / "short", with_tcp(poses, [0.0, 0.0, 0.012])), tmp_path / "out")
    assert any("look as if a TCP of" in w for w in short.result.warnings)
    none = calibrate_dataset(_pairs(tmp_path / "none_set", poses), tmp_path / "bare")
    assert not any("TCP" in w for w in none.result.warnings)


def test_calibrate_says_that_poses_of_one_orientation_cannot_show_a_tcp(tmp_path: Path) -> None:
    data = _pairs(tmp_path / "data", with_tcp(make_observations(12, 8, turn=0.0, normals=False), [0.0, 0.0, 0.15]))
    report = calibrate_dataset(data, tmp_path / "out")
    assert any("it would shift X_BC by its own length" in w for w in report.result.warnings)
