"""weldcal profiler at a prompt: files in, calibrations out, one sentence for each mistake."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.worlds.profiler import CLEAN, SphereWorld, sphere_trial
from weldcal.calibration.profiler.edge.model import EdgeState, predicted
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.plan import sample_edge_poses
from weldcal.calibration.profiler.record import load_record
from weldcal.calibration.profiler.result import ProfilerEstimate, believed_covariance
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app

STATE = EdgeState(
    Rotation.from_euler("xyz", [170.0, -9.0, 52.0], degrees=True).as_matrix(),
    np.array([0.055, 0.021, 0.130]),
    np.array([0.9, -0.2, 0.25]),
    np.array([0.8, 0.58, 0.15]) / np.linalg.norm([0.8, 0.58, 0.15]),
)


def called(*words: object) -> tuple[int, str]:
    """Exit code and all that was printed, its lines made one."""
    result = CliRunner().invoke(app, ["profiler", *(str(w) for w in words)])
    return result.exit_code, " ".join(result.output.split())


def found(*words: object) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["profiler", *(str(w) for w in words), "--json"])
    assert result.exit_code == 0, result.output
    answer: dict[str, Any] = json.loads(result.stdout.strip().splitlines()[-1])
    return answer


@cache
def edge() -> tuple[FlangePoses, np.ndarray]:
    poses = sample_edge_poses(STATE, 24, 3)
    p = predicted(STATE, poses)[0]
    return poses, p + 5e-5 * np.random.default_rng(4).standard_normal(p.shape)


def edge_csv(path: Path, unit: str = "mm") -> Path:
    poses, p = edge()
    k = 1e3 if unit == "mm" else 1.0
    turns = Rotation.from_matrix(poses.rotation).as_rotvec()
    rows = np.column_stack([k * poses.translation, turns, k * p])
    path.write_text(
        ",".join([*(f"{a}_{unit}" for a in "xyz"), "rx_rad", "ry_rad", "rz_rad", f"px_{unit}", f"pz_{unit}"]) + "\n"
        + "\n".join(",".join(repr(float(v)) for v in row) for row in rows) + "\n"
    )  # fmt: skip
    return path


def test_an_edge_from_csv_and_from_npz_in_any_unit_is_the_same_calibration(tmp_path: Path) -> None:
    poses, p = edge()
    np.savez(tmp_path / "m.npz", rotation=poses.rotation, translation=poses.translation, points=p, unit="m")
    np.savez(tmp_path / "mm.npz", rotation=poses.rotation, translation=1e3 * poses.translation, points=1e3 * p)
    sources: list[tuple[object, ...]] = [
        (edge_csv(tmp_path / "mm.csv"),),
        (edge_csv(tmp_path / "m.csv", "m"),),
        (tmp_path / "m.npz",),
        (tmp_path / "mm.npz", "--unit", "mm"),
    ]
    answers = []
    for k, words in enumerate(sources):
        answer = found("edge", *words, "--out", tmp_path / f"out{k}", "--plan", 2 if k == 0 else 0)
        answers.append(load_record(tmp_path / f"out{k}"))
        assert answer["inliers"] == 24
    sigma = np.sqrt(np.diag(answers[0].covariance))  # type: ignore[arg-type]
    assert (np.abs(answers[0].translation - STATE.translation) < 4 * sigma[3:]).all()
    for other in answers[1:]:
        np.testing.assert_allclose(other.rotation, answers[0].rotation, atol=1e-8)
        np.testing.assert_allclose(other.translation, answers[0].translation, atol=1e-8)
    assert len(answers[0].figures["next_poses"]["poses"]) == 2
    assert json.loads((tmp_path / "out0/X_FS.json").read_text())["child"] == "profiler"


def test_a_sphere_with_touches_by_both_methods_and_what_was_written_is_read_back(tmp_path: Path) -> None:
    world = SphereWorld.made(5, CLEAN)
    trial = sphere_trial(world, 500, touches=20, views=0)
    d = trial.data
    assert d.touches is not None
    touch_T = np.tile(np.eye(4), (20, 1, 1))
    touch_T[:, :3, :3], touch_T[:, :3, 3] = d.touches.rotation, d.touches.translation
    content: dict[str, Any] = {
        "unit": "m", "rotation": d.poses.rotation, "translation": d.poses.translation, "profiles": np.array(d.profiles),
        "radius": d.radius_m, "touch_T": touch_T, "tip": d.tip, "sign": trial.sign,
    }  # fmt: skip
    np.savez(tmp_path / "s.npz", **content)
    joint = found(
        "sphere", tmp_path / "s.npz", "--model", "rigid", "--as", "sigma-robot=0.04", "--out", tmp_path / "joint"
    )
    assert joint["reduced_chi2"] == pytest.approx(1.0, abs=0.15)
    record = load_record(tmp_path / "joint")
    assert np.linalg.norm(record.translation - world.translation) < 1e-3
    paper = found("compensate", tmp_path / "s.npz", "--out", tmp_path / "paper")
    assert paper["centre_after_mm"] < paper["centre_before_mm"]
    content["sign"] = trial.sign * np.where(np.arange(20) == 14, -1.0, 1.0)
    np.savez(tmp_path / "w.npz", **content)
    code, text = called("compensate", tmp_path / "w.npz", "--out", tmp_path / "wrong")
    assert code == 0
    assert "likely wrong in scans [14]" in text


def test_scans_without_the_sphere_are_left_out_and_inverse_poses_are_refused(tmp_path: Path) -> None:
    d = sphere_trial(SphereWorld.made(5, CLEAN), 500, touches=8, views=0).data
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = d.poses.rotation, d.poses.translation
    profiles = np.array(d.profiles)
    profiles[7, :, 1] = 0.2
    np.savez(tmp_path / "s.npz", T=T[:, :3], profiles=profiles, radius=d.radius_m, unit="m")
    answer = found("sphere", tmp_path / "s.npz", "--model", "rigid", "--out", tmp_path / "a")
    assert answer["without_sphere"] == [7]
    np.savez(tmp_path / "i.npz", T=np.linalg.inv(T), profiles=np.array(d.profiles), radius=d.radius_m, unit="m")
    code, text = called("sphere", tmp_path / "i.npz", "--model", "rigid", "--out", tmp_path / "b")
    assert code == 1
    assert "inverses of the poses" in text
    np.savez(tmp_path / "t.npz", T=np.swapaxes(T, 1, 2), profiles=np.array(d.profiles), radius=d.radius_m, unit="m")
    code, text = called("sphere", tmp_path / "t.npz", "--out", tmp_path / "b")
    assert code == 1
    assert "transposed" in text
    np.savez(tmp_path / "r.npz", T=T, profiles=np.array(d.profiles), radius=d.radius_m + 0.001, unit="m")
    _, text = called("sphere", tmp_path / "r.npz", "--model", "rigid", "--out", tmp_path / "c", "-v")
    assert "heck the radius" in text


def test_a_groove_is_mapped_with_what_was_calibrated(tmp_path: Path) -> None:
    found("edge", edge_csv(tmp_path / "e.csv"), "--out", tmp_path / "cal")
    x = np.linspace(-0.02, 0.02, 300)
    p = np.column_stack([x, 0.08 + np.clip(0.01 - 2.0 * np.abs(x), 0.0, None)])
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.5
    np.savez(tmp_path / "g.npz", T=T, profiles=np.array([p, p]), unit="m")
    assert (
        found("seam", tmp_path / "g.npz", "--calibration", tmp_path / "cal", "--out", tmp_path / "seam")["found"] == 2
    )
    table = np.genfromtxt(tmp_path / "seam/seam.csv", delimiter=",", names=True)
    root = load_record(tmp_path / "cal").points_F(np.array([[0.0, 0.09]]))[0]
    at = np.array([table[f"root_{a}_mm"] for a in "xyz"]).T
    np.testing.assert_allclose(at, 1e3 * (root + np.array([[0, 0, 0], [0.5, 0, 0]])), atol=0.02)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("edge", "none.npz"), "There is no file"),
        (("edge", "t.txt"), "'t.txt' holds no row of numbers. A table of profiles has columns such as scan,x_mm"),
        (("edge", "broken.npz", "--unit", "mm"), "cannot be read as NPZ"),
        (("edge", "p.npz"), "does not state its unit"),
        (("edge", "p.npz", "--unit", "inch"), "m or mm, not 'inch'"),
        (("edge", "p.npz", "--unit", "m"), "Give --unit mm"),
        (("edge", "e.csv", "--method", "best"), "joint or paper"),
        (("edge", "e.csv", "--feature", "bar"), "no profiles"),
        (
            ("edge", "flat.csv", "--feature", "step"),
            "None of the 8 profiles shows the feature step with its near face on the left, with z away from the sensor or",
        ),
        (("edge", "e.csv", "--as", "sigma-x=0"), "must be positive"),
        (("edge", "bad.csv"), "has the columns a, b: no x and z of profile points. Name them px_mm and pz_mm"),
        (("edge", "word.csv"), "holds no pose for any of the 1 profiles"),
        (("sphere", "e.csv"), "no 'profiles' of the sphere"),
        (("sphere", "e.csv", "--tip", "1,2"), "three numbers in mm"),
        (("seam", "e.csv", "--calibration", "nowhere"), "There is no calibration"),
    ],
)
def test_a_mistake_is_named_in_one_sentence_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    poses, p = edge()
    np.savez("p.npz", rotation=poses.rotation, translation=1e3 * poses.translation, points=1e3 * p)
    Path("t.txt").write_text("x")
    Path("broken.npz").write_text("x")
    Path("bad.csv").write_text("a,b\n1,2\n")
    Path("word.csv").write_text("x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad,px_mm,pz_mm\n1,two,3,0,0,0,1,2\n")
    edge_csv(Path("e.csv"))
    level = [f"{k},{100 * k},0,500,1,0,0,0,{0.1 * j:.1f},200" for k in range(8) for j in range(60)]
    Path("flat.csv").write_text("scan,x_mm,y_mm,z_mm,qw,qx,qy,qz,px_mm,pz_mm\n" + "\n".join(level) + "\n")
    code, text = called(*words, "--out", "out")
    assert code == 1
    assert sentence in text
    assert text.count("weldcal:") == 1
    assert not Path("out").exists()


def test_a_record_changed_by_hand_is_refused(tmp_path: Path) -> None:
    found("edge", edge_csv(tmp_path / "e.csv"), "--out", tmp_path / "cal")
    path = tmp_path / "cal/profiler.yaml"
    text = path.read_text()
    first = text.index("- [") + 3
    path.write_text(text[:first] + "9." + text[first + 2 :])
    with pytest.raises(InputError, match="changed by hand"):
        load_record(path)
    path.write_text("schema: 1\n")
    with pytest.raises(InputError, match="no profiler's calibration"):
        load_record(path)


def test_a_table_of_another_spreadsheet_is_the_same_table_and_the_pose_is_printed(tmp_path: Path) -> None:
    header, *rows = edge_csv(tmp_path / "plain.csv").read_text().splitlines()
    text = "\n".join(["# bench 3", header.upper() + ",note", *(f"{row},fine" for row in rows), ",,,,,,,,"])
    other = tmp_path / "other.csv"
    other.write_text(text.replace(",", ";"))
    answer = found("edge", other, "--out", tmp_path / "out")
    assert np.allclose(np.array(answer["X_FS"])[:3, 3], STATE.translation, atol=1e-3)
    degrees = [
        ",".join([*r.split(",")[:3], *(str(57.3 * float(v)) for v in r.split(",")[3:6]), *r.split(",")[6:]])
        for r in rows
    ]
    other.write_text("\n".join([header, *degrees]))
    assert "seem to be degrees" in called("edge", other)[1]


def test_points_of_three_numbers_are_refused(tmp_path: Path) -> None:
    X = np.tile(np.eye(4), (6, 1, 1))
    X[:, 0, 3] = 500.0
    np.savez(tmp_path / "three.npz", T=X, xz=np.zeros((60, 3)), n=np.full(6, 10), radius=20.0, unit="mm")
    code, said = called("sphere", tmp_path / "three.npz")
    assert code == 1
    assert "(60, 3)" in said
    assert "Internal" not in said


def test_a_direction_that_is_open_by_centimetres_is_refused() -> None:
    vague = SimpleNamespace(reduced_chi2=1.0, scans_chi2=1.0, covariance=np.diag([1e-6] * 3 + [1e-8, 1e-8, 0.4**2]))
    with pytest.raises(
        InputError, match=r"translation along \(0.00, 0.00, 1.00\) of the flange almost open \(one sigma 400 mm\)"
    ):
        believed_covariance(cast(ProfilerEstimate, vague))


def test_a_noisier_sensor_is_no_outlier_and_an_outlier_is_named(tmp_path: Path) -> None:
    poses, p = edge()
    noisy = p + 2.5e-4 * np.random.default_rng(8).standard_normal(p.shape)
    noisy[5] += [6e-3, -4e-3]
    arrays = {"rotation": poses.rotation, "translation": poses.translation, "points": noisy, "unit": "m"}
    np.savez(tmp_path / "noisy.npz", **arrays)
    np.savez(tmp_path / "said.npz", **arrays, sigma=[3e-5, 2.5e-4, 2.5e-4])
    for name in ("noisy", "said"):
        answer = found("edge", tmp_path / f"{name}.npz", "--out", tmp_path / name)
        record = load_record(tmp_path / name)
        assert answer["outlier_scans"] == [5]
        assert answer["sigmas_mm"]["z"] > 0.15
        assert record.covariance is not None
        error = record.translation - STATE.translation
        assert (np.abs(error) < 4.0 * np.sqrt(np.diag(record.covariance))[3:]).all()
    assert "outlier scans 5" in called("edge", tmp_path / "said.npz", "--out", tmp_path / "printed", "-v")[1]
