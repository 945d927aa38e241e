"""Planes, and edge, sphere and planes of one mounting together: the figure's own worlds, made by rays."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.figures.profiler.joint import SENSOR, Made, Scans, made_set, parts_of, planes_of, square_of
from weldcal.calibration.data.stated_pose import read_stated_pose
from weldcal.calibration.errors import DegenerateMotion, FeatureNotFound
from weldcal.calibration.geometry.robust import chi2_quantile
from weldcal.calibration.geometry.se3 import moved, pose
from weldcal.calibration.profiler.combined.planes import line_of
from weldcal.calibration.profiler.combined.scans import FeatureScans
from weldcal.calibration.profiler.combined.solve import solve_joint
from weldcal.calibration.profiler.motion import Floats
from weldcal.calibration.profiler.record import load_record
from weldcal.tools.cli.app import app

SEED = 7


@cache
def world() -> Made:
    return made_set(SEED)


@cache
def parts() -> list[FeatureScans]:
    return parts_of(world())


def save(path: Path, scans: Scans, **more: object) -> Path:
    T = pose(scans.poses.rotation, scans.poses.translation)
    np.savez(path, unit="m", T=T, profiles=np.array(scans.profiles), **more)  # type: ignore[arg-type]
    return path


def called(*words: object) -> tuple[int, dict[str, Any], str]:
    result = CliRunner().invoke(app, ["profiler", *map(str, words), "--json"])
    lines = result.stdout.strip().splitlines()
    return result.exit_code, json.loads(lines[-1]) if lines else {}, " ".join(result.output.split())


@pytest.mark.parametrize("k", [0, 1, 2])
def test_derivatives_are_those_of_the_prediction(k: int) -> None:
    part = parts()[k]
    X, numbers = world().X_FS, part.numbers + 1e-5

    def e(step: Floats, add: Floats) -> Floats:
        Y = X @ moved(np.eye(4), step)  # about S, in its own axes
        R, t = Y[:3, :3], Y[:3, 3]
        poses = part.poses
        return part.placed(poses.rotation @ R, poses.rotation @ t + poses.translation, numbers + add).e

    at = part.placed(part.poses.rotation @ X[:3, :3], part.poses.rotation @ X[:3, 3] + part.poses.translation, numbers)
    h, none, still = 1e-6, np.zeros(len(numbers)), np.zeros(6)
    for j, u in enumerate(np.eye(6)):
        np.testing.assert_allclose(
            (e(h * u, none) - e(-h * u, none)) / (2 * h), at.twist[:, :, j], rtol=1e-4, atol=1e-5
        )
    for j, u in enumerate(np.eye(len(numbers))):
        np.testing.assert_allclose(
            (e(still, h * u) - e(still, -h * u)) / (2 * h), at.numbers[:, :, j], rtol=1e-4, atol=1e-5
        )


def test_the_joint_region_holds_the_truth_and_is_not_wide() -> None:
    e = solve_joint(parts(), SENSOR)
    squares = [square_of(solve_joint(parts_of(made), SENSOR), made.X_FS) for made in map(made_set, range(8, 10))]
    squares.append(square_of(e, world().X_FS))
    # 3 x 6 numbers: 4 times too narrow or too wide multiplies the sum by 16
    assert chi2_quantile(1e-4, 18) < sum(squares) < chi2_quantile(1 - 1e-4, 18)
    assert e.causes == ()
    assert e.edge_radius_m is not None
    assert abs(e.edge_radius_m[0] - world().break_m) < 4.0 * e.edge_radius_m[1]
    assert e.edge_radius_m[1] < 0.3e-3  # the prior's half: the scans carry it


def test_three_planes_alone_give_the_pose_without_a_start() -> None:
    e = solve_joint([planes_of(world())], SENSOR)
    assert square_of(e, world().X_FS) < chi2_quantile(0.9999, 6)
    assert np.linalg.norm(e.translation - world().X_FS[:3, 3]) < 1e-3


def test_one_plane_alone_with_few_tilts_is_refused() -> None:
    one = world().planes[0]
    level = replace(one, poses=one.poses[np.zeros(len(one.poses), dtype=int)])
    with pytest.raises(DegenerateMotion, match="open: tilt the flange"):
        solve_joint([planes_of(replace(world(), planes=(level,)))], SENSOR)


@pytest.mark.parametrize("part", ["edge", "planes"])
def test_a_wrong_tool_of_one_part_is_named_with_its_offset(part: str) -> None:
    off = np.array([0.8e-3, -0.8e-3, 1.6e-3])
    bad = replace(world(), planes=tuple(p.with_tool(off) for p in world().planes))
    if part != "planes":
        bad = replace(world(), **{part: getattr(world(), part).with_tool(off)})
    cause = solve_joint(parts_of(bad), SENSOR).causes[0]
    assert (cause.name, cause.part) == ("shift", part)
    d = cause.value + off  # the mounting moves the other way
    assert d @ np.linalg.solve(cause.covariance, d) < chi2_quantile(0.9999, 3)


def test_a_wrong_radius_of_the_sphere_is_named() -> None:
    cause = solve_joint(parts_of(replace(world(), radius_m=world().radius_m + 0.2e-3)), SENSOR).causes[0]
    assert cause.name == "radius"
    assert "smaller than stated" in cause.words


def test_a_profile_of_two_faces_is_no_line() -> None:
    x = np.linspace(-0.02, 0.02, 200)
    with pytest.raises(FeatureNotFound, match="no single line"):
        line_of(np.column_stack([x, 0.2 + np.abs(x)]))


def test_the_commands_write_one_result_of_all_files(tmp_path: Path) -> None:
    made = world()
    planes = [save(tmp_path / f"p{k}.npz", p) for k, p in enumerate(made.planes)]
    edge, ball = save(tmp_path / "edge.npz", made.edge), save(tmp_path / "ball.npz", made.sphere, radius=0.02)
    given = [f"edge:{edge}", f"sphere:{ball}", *(f"planes:{p}" for p in planes)]
    code, answer, _ = called("joint", *given, "--feature", "bar", "--as", "z=away", "--out", tmp_path / "out")
    assert (code, answer["agree"], answer["parts"]) == (0, True, {"edge": 22, "sphere": 16, "planes": 24})
    record = load_record(tmp_path / "out")
    assert record.covariance is not None
    np.testing.assert_allclose(record.translation, made.X_FS[:3, 3], atol=1e-3)
    code, answer, _ = called("planes", *planes, "--out", tmp_path / "planes")
    assert (code, answer["scans"]) == (0, 24)
    np.testing.assert_allclose(np.array(answer["X_FS"])[:3, 3], made.X_FS[:3, 3], atol=2e-3)
    bad = save(tmp_path / "bad.npz", made.sphere.with_tool(np.array([30e-3, 0.0, 0.0])), radius=0.02)
    code, _, text = called("joint", f"edge:{edge}", f"sphere:{bad}", "--feature", "bar", "--out", tmp_path / "bad")
    assert code == 1
    assert "the tool (TCP) that was active, or the mounting, was another" in text
    bad = save(tmp_path / "off.npz", made.sphere.with_tool(np.array([2e-3, 0.0, 0.0])), radius=0.02)
    code, answer, text = called(
        "joint",
        *(given[0], f"sphere:{bad}", *given[2:]),
        "--feature",
        "bar",
        "--as",
        "z=away",
        "--out",
        tmp_path / "off",
    )
    assert (code, answer["agree"]) == (1, False)
    assert "The verdict is: do not use. The parts disagree: the sphere differs from the other parts by a shift" in text
    assert read_stated_pose(tmp_path / "out").data > read_stated_pose(tmp_path / "planes").data
    for words, sentence in (
        (("plane:table.npz",), "'plane:table.npz' is no part: write edge:FILE, sphere:FILE or planes:FILE."),
        (("edge:",), "'edge:' is no part"),
        ((given[0], given[0]), "edge:FILE is given twice"),
        ((given[2], given[2]), "Two of the files are the same"),
        ((given[0], f"sphere:{tmp_path / 'none.npz'}"), "sphere:none.npz: "),
    ):
        code, _, text = called("joint", *words, "--out", tmp_path / "no")
        assert code == 1
        assert sentence in text


def test_a_refusal_of_trials_names_a_key_that_the_command_takes(tmp_path: Path) -> None:
    made = world()
    poses = [pose(p.poses.rotation, p.poses.translation) for p in made.planes]
    T = np.concatenate(poses)
    profiles = [q for p in made.planes for q in p.profiles]
    length = min(len(q) for q in profiles)
    short = np.array([q[:length] for q in profiles])
    plane = np.repeat(np.arange(len(poses)), [len(X) for X in poses])
    np.savez(tmp_path / "two.npz", unit="m", T=np.array([T, T]), profiles=np.array([short, short]), plane=plane)
    code, _, text = called("planes", tmp_path / "two.npz", "--out", tmp_path / "out")
    assert code == 1
    assert "Choose one with --as trial=0 to 1." in text
    code, answer, _ = called("planes", tmp_path / "two.npz", "--as", "trial=1", "--out", tmp_path / "out")
    assert code == 0
    np.testing.assert_allclose(np.array(answer["X_FS"])[:3, 3], made.X_FS[:3, 3], atol=2e-3)


def test_a_break_moves_the_edge_alone_less_than_its_sigma_states(tmp_path: Path) -> None:
    made = made_set(9)
    code, answer, _ = called(
        "edge", save(tmp_path / "e.npz", made.edge), "--feature", "bar", "--as", "z=away", "--out", tmp_path / "o"
    )
    assert code == 0
    assert abs(answer["edge_radius_mm"] - 1e3 * made.break_m) < 4.0 * answer["edge_radius_sigma_mm"]
    record = load_record(tmp_path / "o")
    assert record.covariance is not None
    d = record.translation - made.X_FS[:3, 3]
    assert d @ np.linalg.solve(record.covariance[3:, 3:], d) < chi2_quantile(0.9999, 3)
