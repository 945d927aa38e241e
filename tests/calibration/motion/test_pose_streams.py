"""Two pose streams with an unknown clock offset: the offset is found with an honest sigma, in simulation and on
recorded arms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.places import SHARED_DATA, require_data
from weldcal.calibration.errors import DatasetError, UndeterminedPoses
from weldcal.calibration.geometry.se3 import exp_rotation, inverse, pose
from weldcal.calibration.motion.pose_streams import PoseStreams, is_stream_file, read_streams, synchronise
from weldcal.calibration.recorded_hand_eye import HandEyeOptions
from weldcal.models.arrays import Array
from weldcal.tools.commands.hand_eye import run_hand_eye

X = pose(exp_rotation(np.array([0.3, -0.2, 1.0])), np.array([0.05, -0.02, 0.1]))
Y = pose(exp_rotation(np.array([-0.5, 0.4, 0.2])), np.array([0.6, 0.1, 0.0]))


def hand_at(t: Array) -> Array:
    """A smooth motion with all rotations."""
    w = 0.5 * np.sin(np.array([0.0, 1.0, 2.0]) + np.outer(t, [1.1, 0.9, 1.3]))
    p = 0.2 * np.sin(np.array([0.5, 0.0, 1.5]) + np.outer(t, [0.7, 1.2, 1.0])) + np.array([0.5, 0.0, 0.4])
    return pose(exp_rotation(w), p)


def streams(offset_s: float, seed: int = 0, *, epoch_s: float = 0.0, seconds: float = 20.0) -> PoseStreams:
    rng = np.random.default_rng(seed)
    t, u = np.arange(0.0, seconds, 0.02), np.arange(0.3, seconds - 0.3, 1.0 / 30.0)
    E = (
        inverse(Y)
        @ hand_at(u)
        @ X
        @ pose(exp_rotation(2e-3 * rng.standard_normal((len(u), 3))), 1e-3 * rng.standard_normal((len(u), 3)))
    )
    return PoseStreams(t + epoch_s, hand_at(t), u + offset_s + epoch_s, E)


def written(folder: Path, s: PoseStreams) -> Path:
    tables = {
        name: np.column_stack([t, P[:, :3, 3], Rotation.from_matrix(P[:, :3, :3]).as_quat()])
        for name, t, P in (("hand", s.hand_time, s.hand), ("eye", s.eye_time, s.eye))
    }
    np.savez(folder / "streams.npz", **tables)  # type: ignore[arg-type]
    return folder / "streams.npz"


@pytest.mark.parametrize(("offset_s", "epoch_s"), [(0.0371, 0.0), (-0.42, 1.5e9)])
def test_offset_and_poses(offset_s: float, epoch_s: float) -> None:
    found = synchronise(streams(offset_s, epoch_s=epoch_s))
    assert abs(found.offset_s - offset_s) < 4.0 * found.sigma_s
    assert found.sigma_s < 5e-4
    assert np.abs(found.X - X).max() < 2e-3
    assert np.abs(found.Y - Y).max() < 2e-3


def test_sigma_is_honest() -> None:
    z = []
    for seed in range(8):
        found = synchronise(streams(0.01, seed, seconds=8.0))
        z.append((found.offset_s - 0.01) / found.sigma_s)
    assert 0.3 < float(np.mean(np.square(z))) < 3.0


def test_command(tmp_path: Path) -> None:
    file = written(tmp_path, streams(0.025, epoch_s=100.0, seconds=6.0))
    assert is_stream_file(file)
    summary = run_hand_eye(file, tmp_path / "out", HandEyeOptions()).summary()
    assert summary["clock_offset_ms"] == pytest.approx(25.0, abs=1.0)
    assert 0.0 < float(str(summary["clock_offset_sigma_ms"])) < 1.0


@pytest.mark.parametrize(("name", "known_ms"), [("sim", -1.0), ("real", 17.0)])
def test_recorded_arms(name: str, known_ms: float) -> None:
    file = SHARED_DATA / "handeye" / f"ethz_asl_robot_arm_{name}" / "streams.npz"
    require_data(file)
    found = synchronise(read_streams(file))
    assert 1e3 * found.offset_s == pytest.approx(known_ms, abs=2.0)


def test_what_cannot_be_used(tmp_path: Path) -> None:
    s = streams(0.0)
    one = np.repeat(s.hand[:1], len(s.hand), axis=0)
    still = PoseStreams(s.hand_time, one, s.eye_time, np.repeat(s.eye[:1], len(s.eye), axis=0))
    with pytest.raises(UndeterminedPoses, match="hardly turns"):
        synchronise(still)
    with pytest.raises(DatasetError, match="overlap"):
        synchronise(PoseStreams(s.hand_time + 500.0, s.hand, s.eye_time, s.eye))
    np.savez(tmp_path / "a.npz", hand=np.zeros((30, 8)), eye=np.zeros((30, 8)))
    with pytest.raises(DatasetError, match="not of length 1"):
        read_streams(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", hand=np.zeros((30, 7)), eye=np.zeros((30, 8)))
    with pytest.raises(DatasetError, match=r"\(n, 8\)"):
        read_streams(tmp_path / "b.npz")


def test_a_short_hole_in_a_stream_is_left_out(tmp_path: Path) -> None:
    s = streams(0.0371)
    keep = (s.hand_time < 8.0) | (s.hand_time > 8.12)
    file = written(tmp_path, PoseStreams(s.hand_time[keep], s.hand[keep], s.eye_time, s.eye))
    report = run_hand_eye(file, tmp_path / "out", HandEyeOptions(mounting="eye_in_hand"))
    assert report.streams is not None
    assert abs(report.streams.offset_s - 0.0371) < 4.0 * report.streams.sigma_s


@pytest.mark.parametrize("inverted", [False, True])
def test_trajectories_of_other_length_and_clock(tmp_path: Path, inverted: bool) -> None:
    s = streams(-0.213, epoch_s=1.6e9)
    folder = tmp_path / "set"
    folder.mkdir()
    for name, t, P in (("robot", s.hand_time, s.hand), ("camera", s.eye_time, inverse(s.eye) if inverted else s.eye)):
        q = Rotation.from_matrix(P[:, :3, :3]).as_quat()
        rows = [f"{a:.6f} " + " ".join(f"{v:.7f}" for v in (*p, *r)) for a, p, r in zip(t, P[:, :3, 3], q, strict=True)]
        (folder / f"{name}.tum").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    report = run_hand_eye(folder, tmp_path / "out", HandEyeOptions(mounting="eye_in_hand"))
    assert report.streams is not None
    assert abs(report.streams.offset_s + 0.213) < 4.0 * report.streams.sigma_s
    assert np.abs(report.streams.X - X).max() < 2e-3
