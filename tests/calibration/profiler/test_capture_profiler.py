"""Profiles captured one by one, of a bar's edge and of a sphere: judged, solved, advised, and used.

The profiles are cuts through a half plane over a floor and through a ball, from their own equations.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from typer.testing import CliRunner

from weldcal.calibration.capture.session import ArmPose, Capture, CaptureSession
from weldcal.calibration.profiler.record import load_record
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.commands.profiler.captured import ProfileTask

X_FS = RigidTransform(RollPitchYaw(np.radians([8.0, -14.0, 60.0])), [0.05, -0.03, 0.11])
AT = np.array([0.7, 0.1, 0.2])
ALONG = np.array([np.cos(0.5), np.sin(0.5), 0.0])
RADIUS = 0.02
ROBOT, NOISE = 3e-5, 3e-5


def cut(target: str, X_BF: RigidTransform, rng: np.random.Generator) -> np.ndarray:
    """The profile [x, z] (n, 2) m of the target under a flange at X_BF; NaN where nothing returns."""
    X = X_BF @ X_FS
    R, o = X.rotation().matrix(), X.translation()
    x = np.linspace(-0.025, 0.025, 640)
    start = o + np.outer(x, R[:, 0])
    if target == "sphere":
        q, u = start - AT, R[:, 2]
        half = q @ u
        free = half**2 - (q**2).sum(axis=1) + RADIUS**2
        z = np.where(free > 0.0, -half - np.sqrt(np.maximum(free, 0.0)), np.nan)
    else:
        z = (AT[2] - start[:, 2]) / R[2, 2]
        beside = (start + z[:, None] * R[:, 2] - AT) @ np.cross([0.0, 0.0, 1.0], ALONG)
        z = np.where(beside > 0.0, z, (AT[2] - 0.03 - start[:, 2]) / R[2, 2])
    return np.column_stack([x, z + NOISE * rng.normal(size=len(x))])


def looking(target: str, rng: np.random.Generator) -> RigidTransform:
    """A flange from which the target is in the laser line."""
    turn = RotationMatrix(RollPitchYaw(np.radians([180.0, 0.0, 0.0]) + np.radians(25.0) * rng.uniform(-1, 1, 3)))
    across = RotationMatrix.MakeZRotation(0.5 + np.pi / 2.0)
    p_S = [
        rng.uniform(-0.01, 0.01),
        rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.8) * RADIUS if target == "sphere" else 0.0,
        rng.uniform(0.07, 0.1),
    ]
    R_BS = across @ turn
    at = AT if target == "sphere" else AT + rng.uniform(-0.05, 0.05) * ALONG
    return RigidTransform(R_BS, at - R_BS @ np.array(p_S)) @ X_FS.inverse()


def write(path: Path, profile: np.ndarray) -> None:
    np.savetxt(path, 1e3 * profile, delimiter=",", header="x_mm,z_mm", comments="")


def take(one: CaptureSession, target: str, X_BF: RigidTransform, rng: np.random.Generator, folder: Path) -> Capture:
    write(folder / "profile.csv", cut(target, X_BF, rng))
    stated = RigidTransform(X_BF.rotation(), X_BF.translation() + ROBOT * rng.normal(size=3))
    return one.take(folder / "profile.csv", ArmPose(X_BF=stated))


@pytest.mark.parametrize(("target", "asked"), [("bar", "edge:bar"), ("sphere", "sphere:20")])
def test_a_profiler_is_calibrated_by_captures(tmp_path: Path, target: str, asked: str) -> None:
    inside = 0
    for seed in range(4):
        rng, folder = np.random.default_rng(seed), tmp_path / f"{seed}"
        one = CaptureSession(folder / "captures", ProfileTask(asked, "ur10e"))
        verdict = one.verdict()
        for _ in range(14):
            goal = None if verdict.advice is None else verdict.advice.X_BF
            taken = take(one, target, goal or looking(target, rng), rng, folder)
            assert not taken.refused
            verdict = one.verdict()
        assert verdict.X is not None, verdict.said
        assert verdict.error_95_m is not None
        assert verdict.advice is not None
        work = np.array([0.0, 0.0, 0.08])
        inside += bool(np.linalg.norm(verdict.X @ work - X_FS @ work) < verdict.error_95_m < 1e-3)
    assert inside >= 3
    words = [*one.task.command(one.folder).split()[1:], "--out", str(tmp_path / "again")]
    assert CliRunner().invoke(app, words).exit_code == 0
    one.task.save(one.folder)
    first, again = load_record(folder / "calibration"), load_record(tmp_path / "again")
    assert (first.translation == again.translation).all(), "as the command gives it"
    X = looking(target, rng)
    write(tmp_path / "p.csv", cut(target, X, rng))
    assert one.check(tmp_path / "p.csv", ArmPose(X_BF=X))[1] < 5e-4
    X = looking(target, rng)
    write(tmp_path / "p.csv", cut(target, X, rng) + np.array([0.0, 0.002]))
    assert one.check(tmp_path / "p.csv", ArmPose(X_BF=X))[1] > 8e-4, "the sensor was moved by 2 mm"


@pytest.mark.parametrize(("target", "asked"), [("bar", "edge:bar"), ("sphere", "sphere:20")])
def test_a_profile_without_the_target_is_refused(tmp_path: Path, target: str, asked: str) -> None:
    rng, one = np.random.default_rng(1), CaptureSession(tmp_path / "s", ProfileTask(asked, ""))
    aside = RigidTransform([0.0, 0.0, 0.0]) @ looking(target, rng)
    beside = RigidTransform(aside.rotation(), aside.translation() + np.array([0.0, 0.2, 0.0]))
    refused = take(one, target, beside, rng, tmp_path).refused
    assert "Bring the" in refused or "return" in refused, refused
    assert not one.captures


def test_several_profiles_in_a_file_are_refused(tmp_path: Path) -> None:
    one = CaptureSession(tmp_path / "s", ProfileTask("edge:bar", ""))
    rng = np.random.default_rng(1)
    for k in range(2):
        write(tmp_path / f"{k}.csv", cut("bar", looking("bar", rng), rng))
    rows = [line for k in range(2) for line in [f"scan{k}", *(tmp_path / f"{k}.csv").read_text().splitlines()]]
    (tmp_path / "two.csv").write_text("\n".join(rows))
    assert one.take(tmp_path / "two.csv", ArmPose(X_BF=RigidTransform([0.5, 0.0, 0.5]))).refused


@pytest.mark.parametrize("text", ["edge", "edge:corner", "sphere:", "sphere:big", "groove:5"])
def test_a_target_that_is_none_is_refused_with_the_forms(text: str) -> None:
    with pytest.raises(InputError, match="edge:bar, edge:step, edge:apex, sphere:RADIUS_MM"):
        ProfileTask(text, "")
