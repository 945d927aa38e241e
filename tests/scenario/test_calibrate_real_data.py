"""The offline calibration on real scans and real pairs: every cloud accounted for, errors held out, bad data
refused."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from tests.places import SHARED_DATA, needs
from weldcal.calibration.data.dataset import load_dataset
from weldcal.calibration.data.results import load_result
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.observation import Observation
from weldcal.calibration.recorded_flange import FlangeOptions
from weldcal.models.errors import InputError
from weldcal.models.flanges import get_flange
from weldcal.tools.recorded import calibrate_dataset
from weldcal.tools.report.calibration import CalibrationReport

DATA = SHARED_DATA / "flange"
AUBO, UR10E = DATA / "aubo_i5_phoxi_s", DATA / "ur10e_phoxi_m"
pytestmark = needs(DATA)


@pytest.fixture(scope="module")
def aubo(tmp_path_factory: pytest.TempPathFactory) -> CalibrationReport:
    return calibrate_dataset(AUBO, tmp_path_factory.mktemp("aubo") / "out", centres=True, compare=True)


@pytest.fixture(scope="module")
def ur10e(tmp_path_factory: pytest.TempPathFactory) -> CalibrationReport:
    return calibrate_dataset(UR10E, tmp_path_factory.mktemp("ur10e") / "out", compare=True)


def test_every_aubo_cloud_is_used_and_held_out_errors_beat_the_paper(aubo: CalibrationReport) -> None:
    d = aubo.summary()
    assert d["n_used"] == 18
    assert d["refused"] == []
    # the paper's method: 0.63 to 0.73 mm on these scans; good centres, rigid: 0.22 to 0.23 (median), 0.30 (mean); with
    # the scanner corrected: 0.16 to 0.20 and 0.17 to 0.20
    assert d["held_out_mm"]["median"] < 0.19
    assert d["held_out_mm"]["mean"] < 0.20
    assert d["held_out_mm"]["p95"] < 0.33
    assert d["k_fold_mm"]["median"] < 0.21
    # normals scatter by 0.07 deg per axis between scans; where the image's bends are corrected, 0.05
    assert d["tilt_deg"]["median"] < 0.065
    assert any("constant bias of the flange centre" in s for s in d["unobservable"])


def test_the_scanner_of_the_aubo_is_corrected_as_its_hole_circle_and_the_robot_both_ask(
    aubo: CalibrationReport,
) -> None:
    c = aubo.summary()["scanner_correction"]
    # from other people's fits of this set: 0.16 to 0.21 % short, 0.13 to 0.15 % per 100 mm along x, each to 0.02 to
    # 0.04
    assert c["scale"] == pytest.approx(1.0018, abs=6e-4)
    assert c["gradient_per_m"][0] == pytest.approx(0.014, abs=5e-3)
    assert abs(c["gradient_per_m"][1]) < 6e-3
    scanner = aubo.scanner
    assert scanner is not None
    assert scanner.motion is not None
    assert scanner.holes is not None
    assert any(w == scanner.sentence for w in aubo.result.warnings)
    # the centres are those that the scanner saw
    row = (aubo.out / "centres.csv").read_text().splitlines()[1].split(",")
    assert np.allclose([float(v) for v in row[1:4]], aubo.seen.fits[row[0]].center_C, atol=1e-9)


def test_pairs_without_clouds_are_not_corrected_and_the_result_says_what_motion_asks(ur10e: CalibrationReport) -> None:
    d = ur10e.summary()
    assert d["scanner_correction"] is None
    assert any("The scanner is not corrected" in w and "+0.23 %" in w and "to confirm it" in w for w in d["warnings"])


def test_algorithm_1_reports_less_than_the_truth_and_the_report_says_what_it_misses(aubo: CalibrationReport) -> None:
    a = aubo.algorithm1
    assert a is not None
    assert a.figure_mm < 0.5 * a.true_mm["median"]
    assert "rotation about the flange axis" in a.unseen
    assert "in the flange plane, x" in a.unseen
    html = (aubo.out / "report.html").read_text()
    assert a.verification in html
    assert "rotation about the flange axis" in html
    assert "http" not in html.replace("http://www.w3.org", "").replace("http-equiv", "")


def test_ur10e_pairs_find_their_outlier_and_beat_the_paper(ur10e: CalibrationReport) -> None:
    d = ur10e.summary()
    assert d["n_used"] == 45
    assert len(d["outliers"]) == 1
    assert [r["id"] for r in d["refused"]] == d["outliers"]
    # the paper's method: 0.74 mm; a robust fit of all pairs: 0.62
    assert d["held_out_mm"]["median"] < 0.62
    assert d["k_fold_mm"]["median"] < 0.625
    assert d["tilt_deg"]["median"] is None
    assert ur10e.algorithm1 is not None
    assert "instead of the ICP" in ur10e.algorithm1.metric


def test_result_folder_is_complete_and_reads_back(aubo: CalibrationReport) -> None:
    names = {p.name for p in aubo.out.iterdir()}
    assert {"calibration.yaml", "report.html", "X_BC.json", "centres.csv"} <= names
    back = load_result(aubo.out)
    assert np.allclose(back.X_BC.GetAsMatrix34(), aubo.result.X_BC.GetAsMatrix34())
    assert len(back.data_hashes) == 20
    assert (aubo.out / "centres.csv").read_text().count("\n") == 19
    json.dumps(aubo.summary(), allow_nan=False)


def test_franka_ply_in_millimetres_is_read_and_fitted() -> None:
    from weldcal.calibration.data.dataset import load_dataset

    points = load_dataset(DATA / "franka_phoxi_m").cloud("pose04")
    fit = fit_flange(points, get_flange("iso9409-1-50-4-m6"))
    assert fit.coverage > 0.9
    # chamfered edge of a 63 mm flange
    assert fit.outer_radius_m == pytest.approx(0.0308, abs=5e-4)


def _keep(folder: Path, n: int) -> None:
    lines = (folder / "poses.csv").read_text().splitlines()
    (folder / "poses.csv").write_text("\n".join(lines[: n + 1]) + "\n")
    kept = {line.split(",")[0] for line in lines[1 : n + 1]}
    for path in (folder / "clouds").iterdir():
        if path.stem not in kept:
            path.unlink()


def _nan(folder: Path) -> None:
    for path in sorted((folder / "clouds").iterdir()):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.full((500, 3), np.nan)))
        o3d.io.write_point_cloud(path, cloud)


def _millimetres(folder: Path) -> None:
    for path in sorted((folder / "clouds").iterdir()):
        points = 1e3 * np.asarray(o3d.io.read_point_cloud(path).points)
        o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))


def _missing_pose(folder: Path) -> None:
    lines = (folder / "poses.csv").read_text().splitlines()
    (folder / "poses.csv").write_text("\n".join(lines[:3] + lines[4:]) + "\n")


def _nan_pose(folder: Path) -> None:
    lines = (folder / "poses.csv").read_text().splitlines()
    cells = lines[2].split(",")
    lines[2] = ",".join([cells[0], "nan", *cells[2:]])
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")


def _empty_of_four(folder: Path) -> None:
    _keep(folder, 4)
    next(iter(sorted((folder / "clouds").iterdir()))).write_bytes(b"")


def _first_pairs(folder: Path, n: int) -> None:
    lines = (folder / "pairs.csv").read_text().splitlines()
    (folder / "pairs.csv").write_text("\n".join(lines[: n + 1]) + "\n")


def _coplanar(folder: Path) -> None:
    lines = (folder / "pairs.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    flat = [r for r in rows if abs(float(r[3]) - 0.48) < 1e-3]
    flat = [flat[0], flat[1], flat[-2], flat[-1]]
    assert len(flat) == 4
    (folder / "pairs.csv").write_text("\n".join([lines[0], *(",".join(r) for r in flat)]) + "\n")


@pytest.mark.parametrize(
    ("source", "spoil", "sentence"),
    [
        (AUBO, _nan, r"pose02: Every point of pose02\.pcd is missing \(NaN or 0 0 0\)"),
        (AUBO, _millimetres, r"pose02\.pcd lie \d+ m from the camera, as m: they look like mm"),
        (AUBO, _missing_pose, r"no pose for pose06\.pcd"),
        (AUBO, _nan_pose, "nan in column x of 'pose04'"),
        (AUBO, _empty_of_four, r"pose02: The cloud pose02\.pcd is empty"),
        (AUBO, lambda f: _keep(f, 1), "One scan leaves a rotation open. .* with --axis-turn DEGREES"),
        (UR10E, lambda f: _first_pairs(f, 2), "Two centres leave a rotation open"),
        (UR10E, lambda f: _first_pairs(f, 3), "The 3 flange centres lie on one line"),
        (UR10E, _coplanar, "lie in one plane"),
    ],
    ids=[
        "NaN points",
        "millimetres",
        "missing pose",
        "NaN in a pose",
        "empty cloud",
        "one pose",
        "two pairs",
        "three pairs in a row",
        "four coplanar",
    ],
)
def test_bad_data_get_one_sentence_and_leave_nothing(
    tmp_path: Path, source: Path, spoil: Callable[[Path], None], sentence: str
) -> None:
    folder = tmp_path / "data"
    shutil.copytree(source, folder, copy_function=shutil.copyfile)
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755)
    if source is AUBO:
        _keep(folder, 6)
    spoil(folder)
    with pytest.raises(InputError, match=sentence) as caught:
        calibrate_dataset(folder, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def _part(folder: Path) -> None:
    path = folder / "clouds" / "pose04.pcd"
    points = np.asarray(o3d.io.read_point_cloud(path).points)
    part = points[points[:, 0] < np.quantile(points[:, 0], 0.2)]
    o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(part)))


def _emptied(folder: Path) -> None:
    (folder / "clouds" / "pose04.pcd").write_bytes(b"")


@pytest.mark.parametrize(("spoil", "reason"), [(_part, ""), (_emptied, "is empty")])
def test_one_bad_cloud_among_good_ones_is_refused_by_name(
    tmp_path: Path, spoil: Callable[[Path], None], reason: str
) -> None:
    folder = tmp_path / "data"
    shutil.copytree(AUBO, folder, copy_function=shutil.copyfile)
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755)
    _keep(folder, 6)
    spoil(folder)
    d = calibrate_dataset(folder, tmp_path / "out").summary()
    assert d["n_used"] == 5
    assert d["refused"][0]["id"] == "pose04"
    assert d["refused"][0]["reason"].endswith(".")
    assert re.search(reason, d["refused"][0]["reason"])


def test_missing_points_of_a_cloud_are_left_out_and_the_cloud_is_used(tmp_path: Path) -> None:
    """NaN and 0 0 0 are how scanners write a pixel without a measurement: the same result as without these points."""
    found = []
    for name in ("missing", "absent"):
        folder = tmp_path / name
        shutil.copytree(AUBO, folder, copy_function=shutil.copyfile)
        for path in [folder, *folder.rglob("*")]:
            path.chmod(0o755)
        _keep(folder, 6)
        cloud = folder / "clouds" / "pose04.pcd"
        points = np.array(o3d.io.read_point_cloud(cloud).points)
        points[:5], points[5:10] = np.nan, 0.0
        kept = points if name == "missing" else points[10:]
        o3d.io.write_point_cloud(cloud, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(kept)))
        report = calibrate_dataset(folder, tmp_path / f"out-{name}")
        d = report.summary()
        assert (d["n_used"], d["refused"]) == (6, [])
        found.append(report.result.X_BC.GetAsMatrix4())
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)


@pytest.mark.parametrize(
    ("n", "turn", "limit_mm"), [(1, True, 0.7), (2, False, 0.6), (3, False, 0.45)], ids=["one", "two", "three"]
)
def test_one_to_three_scans_calibrate_and_say_what_their_figures_rest_on(
    aubo: CalibrationReport, tmp_path: Path, n: int, turn: bool, limit_mm: float
) -> None:
    folder = tmp_path / "data"
    shutil.copytree(AUBO, folder, copy_function=shutil.copyfile)
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755)
    _keep(folder, n)
    known = aubo.result.axis_turn_deg
    assert (
        known is not None
    )  # the drilled pattern of this arm is turned by a degree or so: 0.85 to 0.91 in other people's hands
    assert known[0] == pytest.approx(0.88, abs=0.1)
    report = calibrate_dataset(folder, tmp_path / "out", FlangeOptions(axis_turn_deg=known[0] if turn else None))
    assert f"From {'one scan' if n == 1 else f'{n} scans'} only" in report.result.warnings[0]
    assert np.isfinite(report.result.held_out_mm["median"]) == (n == 3)
    assert load_result(tmp_path / "out").covariance.shape == (6, 6)
    # other people's fits of this set: 0.44 mm from one scan, 0.24 to 0.33 from two and three, medians over draws; this
    # is one draw
    seen = {o.id for o in report.observations}
    rest = [o for o in _as_seen(aubo) if o.id not in seen]
    assert 1e3 * float(np.median(position_errors(report.result.X_BC, rest))) < limit_mm


def test_one_scan_of_a_flange_with_slots_is_calibrated(tmp_path: Path) -> None:
    report = calibrate_dataset(DATA / "franka_phoxi_m", tmp_path / "out", FlangeOptions(axis_turn_deg=0.0))
    pattern = report.seen.patterns["pose04"]
    assert pattern.turn_known
    assert pattern.rms_m < 2e-4
    assert abs(pattern.ratio - 1.0) < 0.01


def _as_seen(aubo: CalibrationReport) -> list[Observation]:
    """The sightings of all scans without a correction of the scanner."""
    X_BR = {o.id: o.X_BR for o in aubo.observations}
    return [Observation(id, X_BR[id], fit.center_C) for id, fit in aubo.seen.fits.items()]


def _list_of_pairs(folder: Path, seed: int, n: int, gross: dict[int, float], *, unit: str, turned: bool) -> None:
    """Pairs of the UR10e as another program might write them: drawn anew, columns in another order, rows ``gross`` off
    by so much (m)."""
    rng = np.random.default_rng(seed)
    with (UR10E / "pairs.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["id"] != "34"]  # the one gross outlier of the set itself
    columns = ["id", *(f"{frame}_{axis}" for frame in ("camera", "base") for axis in "zyx")]
    columns += ["base_qz", "base_qy", "base_qx", "base_qw"] if turned else []
    factor = 1e3 if unit == "mm" else 1.0
    lines = [",".join(columns)]
    for k, i in enumerate(rng.permutation(len(rows))[:n]):
        wrong = rng.standard_normal(3)
        wrong *= gross.get(k, 0.0) / np.linalg.norm(wrong)
        values = {name: rows[i][name] for name in columns} | {"id": f"pair{k}"}
        for axis, off in zip("xyz", wrong, strict=True):
            values[f"camera_{axis}"] = repr(float(factor * (float(rows[i][f"camera_{axis}"]) + off)))
            values[f"base_{axis}"] = repr(factor * float(rows[i][f"base_{axis}"]))
        lines.append(",".join(values[name] for name in columns))
    folder.mkdir()
    (folder / "pairs.csv").write_text("\n".join(lines) + "\n")
    header = (UR10E / "dataset.yaml").read_text().replace("{clouds: m, poses: m}", f"{{clouds: {unit}, poses: {unit}}}")
    (folder / "dataset.yaml").write_text(header)


@pytest.mark.parametrize("seed", range(3))
def test_every_gross_outlier_of_a_list_is_named_and_none_else(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = (45, 40, 43)[seed]
    # a third of the list wrong by a centimetre to a decimetre; or four in a sequence, three of them by 3 mm and more
    many = {int(k): float(rng.uniform(0.01, 0.1)) for k in rng.permutation(n)[: int(0.35 * n)]}
    gross = {20: 0.037, 21: 0.0045, 22: 0.0047, 23: 0.0045} if seed == 2 else many
    _list_of_pairs(tmp_path / "list", seed, n, gross, unit=("mm", "m", "mm")[seed], turned=seed == 1)
    data = load_dataset(tmp_path / "list")
    found, all_good = (
        estimate_eye_on_base([Observation(p.id, p.X_BR, p.p_CR) for p in pairs], SolveConfig(leave_one_out=False))
        for pairs in (data.pairs, load_dataset(UR10E).pairs)
    )
    whole = load_dataset(UR10E).pairs
    assert {p.id for p, keep in zip(data.pairs, found.inliers, strict=True) if not keep} == {f"pair{k}" for k in gross}
    # other people's robust fits of such lists: 0.30 to 0.35 mm from the one of all good pairs; a plain fit 12 to 20 mm
    apart = [np.linalg.norm((found.X_BC @ o.p_CR) - (all_good.X_BC @ o.p_CR)) for o in whole]
    assert 1e3 * float(np.median(apart)) < 0.35
