"""`weldcal calibrate` on a rendered recording of a scanner on the arm in motion: X_FC, target and clock against the
truth."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.documents.scans import WRIST_POSES, write_wrist_scans
from tests.documents.scans import X_FC as X_WRIST
from tests.worlds.flange_frames import flange_frame
from tests.worlds.moves import TargetInHand, observed_frames
from tests.worlds.streams import ROBOT, Moves, closed_moves, recorded_stream
from weldcal.calibration.data.header import DatasetHeader
from weldcal.calibration.data.motion_dataset import FrameTime, save_motion_dataset
from weldcal.calibration.errors import DatasetError, TooFewPoses, UndeterminedPoses
from weldcal.calibration.motion.estimate import estimate_in_motion
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arms.chain import load_chain
from weldcal.models.arms.inverse import nearest_solution
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.app import app
from weldcal.tools.commands.mounting_live import calibrate_recorded
from weldcal.tools.recorded import calibrate_dataset

SECONDS, EVERY = 12.0, 3
TARGET = "iso9409-1-50-4-m6"

Truth = tuple[Path, RigidTransform, RigidTransform]


def hand_moves(
    rng: np.random.Generator, *, lean_deg: float = 25.0, spread_m: float = 0.08, waypoints: int = 6
) -> tuple[Moves, RigidTransform, RigidTransform]:
    """Moves of a UR10e with a scanner on its flange about a fixed target, X_FC and X_BT; the target stays near the
    middle of the view."""
    chain = load_chain(ROBOT)
    X_FC = RigidTransform(
        RotationMatrix(
            Rotation.from_euler("zxy", [rng.uniform(-np.pi, np.pi), *rng.uniform(-0.2, 0.2, 2)]).as_matrix()
        ),
        np.array([0.08, 0.02, 0.06]) + rng.uniform(-0.02, 0.02, 3),
    )
    X_BT = RigidTransform(
        RotationMatrix(Rotation.from_euler("xy", rng.uniform(-0.1, 0.1, 2)).as_matrix()),
        [rng.uniform(0.55, 0.7), rng.uniform(-0.2, 0.2), 0.02],
    )
    q: list[Array] = []
    near = np.array([0.2, -1.4, 2.0, -2.1, -1.6, 0.0])
    while len(q) < waypoints:
        lean = np.radians(lean_deg) * rng.uniform(-1.0, 1.0, 3)
        R_BC = Rotation.from_euler("zxy", [lean[0], np.pi + lean[1], lean[2]]).as_matrix()
        p = X_BT.translation() - rng.uniform(0.5, 0.62) * R_BC[:, 2] + spread_m * rng.uniform(-1.0, 1.0, 3)
        X_BF = RigidTransform(RotationMatrix(R_BC), p) @ X_FC.inverse()
        found = nearest_solution(chain, X_BF, near)
        if found is not None:
            near = near + np.mod(found - near + np.pi, 2.0 * np.pi) - np.pi
            q.append(near)
    return closed_moves(np.array(q), linear=False), X_FC, X_BT


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """Every third frame of 12 s at 20 per second, with device times, and the true X_FC and X_BT."""
    folder = tmp_path_factory.mktemp("hand") / "recording"
    rng = np.random.default_rng(2)
    scanner = get_scanner("motioncam_3d_motion", 480)
    scanner = replace(scanner, noise=replace(scanner.noise, sigma_m=1e-4))
    moves, X_FC, X_BT = hand_moves(rng)
    seen = TargetInHand(moves, X_BT)
    frames, capture = observed_frames(seen, X_FC, SECONDS, rng, device=True, epoch_s=100.0)
    picked = range(0, len(capture), EVERY)

    def clouds() -> Iterator[tuple[str, Array]]:
        for j, k in enumerate(picked):
            X_CT = X_FC.inverse() @ RigidTransform(seen.at(capture[k]))
            shown = flange_frame(scanner, get_flange(TARGET), np.random.default_rng(j), X_CR=X_CT, clutter=0)
            yield f"f{j:04d}", shown.points_C

    assert frames.device is not None
    times = [FrameTime(f"f{j:04d}", float(frames.arrival[k]), float(frames.device[k])) for j, k in enumerate(picked)]
    header = DatasetHeader(robot="ur10e", flange=TARGET, scanner="motioncam_3d_motion", configuration="eye_in_hand")
    stream = recorded_stream(moves, SECONDS, rng, joints=True)
    intrinsics = (scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    save_motion_dataset(folder, header, stream, times, clouds(), intrinsics=intrinsics)
    return folder, X_FC, X_BT


def test_the_scanner_on_the_arm_and_its_clock_are_found(recording: Truth, tmp_path: Path) -> None:
    folder, X_FC, X_BT = recording
    ran = CliRunner().invoke(app, ["calibrate", str(folder), "--json", "--out", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    said = json.loads(ran.output.strip().splitlines()[-1])
    assert (said["configuration"], said["clock"]) == ("eye_in_hand", "device")
    assert "X_BC" not in said
    found, p = np.array(said["X_FC"]), np.array([0.0, 0.0, 0.56, 1.0])
    assert 1e3 * np.linalg.norm((found @ p)[:3] - (X_FC.GetAsMatrix4() @ p)[:3]) < 0.15
    assert 1e3 * np.array(said["target"]["xyz"]) == pytest.approx(1e3 * X_BT.translation(), abs=0.15)
    assert said["target"]["normal"] == pytest.approx(X_BT.rotation().matrix()[:, 2], abs=5e-4)
    assert said["clock_offset_ms"] == pytest.approx(1e5, abs=1.0)
    assert said["held_out_mm"]["median"] < 0.2
    written = (tmp_path / "out" / "calibration.yaml").read_text()
    assert "X_FC:" in written
    assert "--frame-id tool0" in (tmp_path / "out" / "static_transform.sh").read_text()
    watched = CliRunner().invoke(app, ["monitor", str(folder), "--calibration", str(tmp_path / "out")])
    assert watched.exit_code == 1
    assert "X_FC" in watched.stderr


def test_at_rest_the_other_command_is_named(recording: Truth, tmp_path: Path) -> None:
    folder = tmp_path / "rest"
    folder.mkdir()
    text = (recording[0] / "dataset.yaml").read_text()
    (folder / "dataset.yaml").write_text(text.replace("mode: motion", "mode: static"))
    with pytest.raises(DatasetError, match="Give the folder to 'weldcal calibrate'"):
        calibrate_dataset(folder, tmp_path / "out")


def test_without_turns_the_pose_is_open() -> None:
    rng = np.random.default_rng(3)
    moves, X_FC, X_BT = hand_moves(rng, lean_deg=0.0, spread_m=0.1)
    shifted = closed_moves(moves.q, linear=True)
    frames, _ = observed_frames(TargetInHand(shifted, X_BT), X_FC, 12.0, rng, device=True)
    motion = ContinuousMotion(recorded_stream(shifted, 12.0, rng), inverted=True)
    with pytest.raises(UndeterminedPoses, match="target's"):
        estimate_in_motion(frames, motion, held_out=False)


@pytest.mark.parametrize("scale", [1.0, 0.998])
def test_scans_at_rest_of_the_foot_place_a_scanner_on_the_wrist(tmp_path: Path, scale: float) -> None:
    """Scans of an independent ray caster, of a true scanner and of one that measures 0.2 % short."""
    report = calibrate_recorded(write_wrist_scans(tmp_path / "scans", scale), tmp_path / "out", limit_mm=0.8)
    result = report.result
    assert result is not None
    assert len(report.status.seen) == len(WRIST_POSES)
    p = np.array([0.0, 0.0, 0.65])
    assert (
        np.linalg.norm(result.place(scale * p) - X_WRIST @ p) < 1e-4
    )  # the arm is exact here, the scans have 0.1 mm of noise
    assert np.linalg.norm(result.X.translation() - X_WRIST.translation()) < 2e-4
    assert result.correction.scale == pytest.approx(1.0 / scale, abs=3e-4)
    assert result.held_out.rms_translation < 1e-4
    assert report.first.verdict == "use it"


def test_a_wrong_guess_is_named_with_its_distance(tmp_path: Path) -> None:
    folder = write_wrist_scans(tmp_path / "scans")
    header = yaml.safe_load((folder / "dataset.yaml").read_text())
    header["scanner_guess"]["xyz"][0] += 0.3
    (folder / "dataset.yaml").write_text(yaml.safe_dump(header))
    with pytest.raises(
        TooFewPoses, match=r"a circle lies \d+ mm .* or write radius_m: 0.25 in scanner_guess"
    ) as caught:
        calibrate_recorded(folder, tmp_path / "out")
    off = int(re.findall(r"lies (\d+) mm", str(caught.value))[0])
    assert 270 <= off <= 330
    header["scanner_guess"]["radius_m"] = 0.25
    (folder / "dataset.yaml").write_text(yaml.safe_dump(header))
    report = calibrate_recorded(folder, tmp_path / "out")
    assert report.result is not None
    assert np.linalg.norm(report.result.X.translation() - X_WRIST.translation()) < 2e-4


def test_a_missing_joint_angle_is_named(tmp_path: Path) -> None:
    folder = write_wrist_scans(tmp_path / "scans")
    first, *rows = (folder / "poses.csv").read_text().splitlines()
    lines = [f"{first},q1,q2,elbow,q4,q5,q6", *(f"{row},0.1,0.1,0.1,0.1,0.1,0.1" for row in rows)]
    (folder / "poses.csv").write_text("\n".join(lines))
    with pytest.raises(DatasetError, match="has no q3 of '"):
        calibrate_recorded(folder, tmp_path / "out")


def test_a_link_that_does_not_carry_the_scanner_is_refused(tmp_path: Path) -> None:
    folder = write_wrist_scans(tmp_path / "scans")
    header = yaml.safe_load((folder / "dataset.yaml").read_text()) | {"scanner_link": "forearm"}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(header))
    with pytest.raises(InputError, match="Remove scanner_link"):
        calibrate_recorded(folder, tmp_path / "out")
