"""Profiles as makers' software and people's scripts write them: each form gives the calibration that the generator
knows."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from weldcal.calibration.errors import InconsistentData
from weldcal.calibration.profiler.importing import ImportedProfiles, import_profiles
from weldcal.calibration.profiler.motion import FlangePoses
from weldcal.calibration.profiler.reading_choice import ReadingFit, choose_reading, sphere_fit
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app

RADIUS = 20.0
R_FS = Rotation.from_euler("xyz", [171.0, -12.0, 85.0], degrees=True)
P_FS = np.array([35.0, -68.0, 165.0])
CENTRE = np.array([930.0, 60.0, 260.0])
SCANS, POINTS, PITCH = 9, 60, 0.4


@dataclass(frozen=True, eq=False)
class World:
    """Flange positions (n, 3) mm and rotations, heights (n, m) mm of the profiles at x (m,), NaN beyond the sphere."""

    p: np.ndarray
    R: Rotation
    x: np.ndarray
    z: np.ndarray


@cache
def world(
    seed: int = 3, turn: float = 28.0, scans: int = SCANS, noise_mm: float = 0.02, axis: tuple[float, ...] = ()
) -> World:
    """A sphere seen from above in turned poses: z of a profile point is where the ray of its column first meets the
    sphere.

    With an ``axis`` the flange turns about it only.
    """
    rng = np.random.default_rng(seed)
    x = PITCH * (np.arange(POINTS) - 0.5 * (POINTS - 1))
    down = (R_FS.inv()).as_matrix()
    turns = rng.uniform(-turn, turn, (scans, 3))
    if axis:
        turns = turns[:, :1] * axis
    R_BS = Rotation.from_rotvec(np.radians(turns)) * Rotation.from_euler("xyz", [180.0, 0.0, 20.0], degrees=True)
    R_BF = Rotation.from_matrix(R_BS.as_matrix() @ down)
    c_S = np.column_stack(
        [rng.uniform(-4.0, 4.0, scans), rng.uniform(-9.0, 9.0, scans), rng.uniform(210.0, 240.0, scans)]
    )
    p = CENTRE - R_BF.apply(R_FS.apply(c_S) + P_FS)
    square = RADIUS**2 - c_S[:, 1:2] ** 2 - (x - c_S[:, :1]) ** 2
    with np.errstate(invalid="ignore"):
        z = c_S[:, 2:] - np.sqrt(square)
    return World(p, R_BF, x, z + noise_mm * rng.standard_normal(z.shape))


def number(v: float, digits: int = 4, comma: bool = False) -> str:
    text = f"{v:.{digits}f}"
    return text.replace(".", ",") if comma else text


def gocator_raw(w: World) -> str:
    """RawProfile: a row of X and a row of Z for each frame; nothing where nothing was measured."""
    head = [
        "Info",
        "CSV Version,Sensor Count,Trigger Mode,Trigger Rate",
        "2,1,0,100.0",
        "End",
        "DeviceInfo",
        "ID,Model,Version",
        "1,2130,5.3",
        "End",
    ]
    lines = [*head, "RawProfile", "Frame Count,Column Count,X Offset,Y Offset,Z Offset", f"{SCANS},{POINTS},0,0,0"]
    lines.append("Frame,Source,Time,Encoder,Z Encoder,Inputs,Exposure,Y,Axis," + ",".join(map(str, range(POINTS))))
    for k, z in enumerate(w.z):
        lead = f"{k},0,{10.0 * k},0,0,0,300,0"
        lines.append(f"{lead},X," + ",".join(number(a) for a in w.x))
        lines.append(f"{lead},Z," + ",".join("" if np.isnan(v) else number(v) for v in z))
        lines.append(f"{lead},I," + ",".join("120" for _ in z))
    return "\r\n".join([*lines, "End"]) + "\r\n"


def gocator_uniform(w: World) -> str:
    """Profile: the x of each column in the header, a row of Z for each frame."""
    lines = [
        "Info",
        "CSV Version,Sensor Count",
        "2,1",
        "End",
        "Profile",
        "Frame Count,Column Count,X Offset,Y Offset,Z Offset",
        f"{SCANS},{POINTS},0,0,0",
    ]
    lines.append("Frame,Source,Time,Encoder,Z Encoder,Inputs,Exposure,Y,Axis," + ",".join(number(a) for a in w.x))
    for k, z in enumerate(w.z):
        lines.append(f"{k},0,{10.0 * k},0,0,0,300,0,Z," + ",".join("" if np.isnan(v) else number(v) for v in z))
    return "\n".join([*lines, "End"]) + "\n"


def gocator_surface(w: World) -> str:
    """Surface: x in the first row, y in the first column."""
    lines = ["Info", "CSV Version,Sensor Count", "2,1", "End", "Surface"]
    lines.append("Frame,Source,Time,Encoder,Z Encoder,Inputs,Row Count,Column Count,X Offset,Y Offset,Z Offset")
    lines += [f"0,0,0,0,0,0,{SCANS},{POINTS},0,0,0", "," + ",".join(number(a) for a in w.x)]
    for k, z in enumerate(w.z):
        lines.append(f"{0.5 * k}," + ",".join("" if np.isnan(v) else number(v) for v in z))
    return "\n".join([*lines, "End"]) + "\n"


def scancontrol_table(w: World) -> str:
    """One table with the profile's number, decimal commas; 0;0 where nothing was measured."""
    lines = ["scanCONTROL 2900-50", "Profile;X [mm];Z [mm];Intensity"]
    for k, z in enumerate(w.z):
        for a, v in zip(w.x, z, strict=True):
            lines.append(
                f"{k};0,000;0,000;0" if np.isnan(v) else f"{k};{number(a, comma=True)};{number(v, comma=True)};512"
            )
    return "\n".join(lines) + "\n"


def scancontrol_blocks(w: World) -> str:
    """A block with its own caption and header for each profile."""
    blocks = []
    for k, z in enumerate(w.z):
        rows = [f"{number(a, 3, True)};{number(v, 3, True)}" for a, v in zip(w.x, z, strict=True) if np.isfinite(v)]
        blocks.append("\n".join([f"Profile {k + 1}", "X [mm];Z [mm]", *rows]))
    return "\n\n".join(blocks) + "\n"


def heights_with_x(w: World) -> str:
    """A grid of heights with the x of the columns in the first row, -99999.9999 where nothing was measured."""
    rows = [",".join(number(a) for a in w.x)]
    rows += [",".join(number(-99999.9999 if np.isnan(v) else v) for v in z) for z in w.z]
    return "\n".join(rows) + "\n"


def heights_in_columns(w: World) -> str:
    """Tabs: the x in the first column, a column of heights for each profile."""
    rows = [
        "\t".join([number(a), *(number(-99.9999 if np.isnan(v) else v) for v in w.z[:, j])]) for j, a in enumerate(w.x)
    ]
    return "\n".join(rows) + "\n"


def named_columns(w: World) -> str:
    """A header: X [mm] and one column of heights for each profile."""
    rows = [";".join(["X [mm]", *(f"Profile {k + 1}" for k in range(SCANS))])]
    rows += [
        ";".join([number(a, 3, True), *("" if np.isnan(v) else number(v, 3, True) for v in w.z[:, j])])
        for j, a in enumerate(w.x)
    ]
    return "\n".join(rows) + "\n"


def heights_only(w: World) -> str:
    return "\n".join(",".join(number(-99999.9999 if np.isnan(v) else v) for v in z) for z in w.z) + "\n"


def heights_in_lines(w: World) -> str:
    """A height a line, nan where nothing was measured, an empty line after each profile."""
    return "\n\n".join("\n".join("nan" if np.isnan(v) else repr(float(v)) for v in z) for z in w.z) + "\n"


def raw_integers(w: World) -> str:
    """Tabs, unmodified integers in 0.01 micrometres with the most negative one for nothing: a column for each
    profile."""
    rows = [
        "\t".join([f"{round(1e5 * a)}", *(f"{-2147483648 if np.isnan(v) else round(1e5 * v)}" for v in w.z[:, j])])
        for j, a in enumerate(w.x)
    ]
    return "\n".join(rows) + "\n"


FORMS: dict[str, tuple[Callable[[World], str], tuple[str, ...]]] = {
    "gocator_raw.csv": (gocator_raw, ()),
    "gocator_uniform.csv": (gocator_uniform, ()),
    "gocator_surface.csv": (gocator_surface, ()),
    "scancontrol_table.csv": (scancontrol_table, ()),
    "scancontrol_blocks.csv": (scancontrol_blocks, ()),
    "heights_with_x.csv": (heights_with_x, ()),
    "heights_in_columns.txt": (heights_in_columns, ()),
    "named_columns.csv": (named_columns, ()),
    "heights_only.csv": (heights_only, ("--as", f"pitch={PITCH}")),
    "heights_in_lines.txt": (heights_in_lines, ("--as", f"pitch={PITCH}")),
    "raw_integers.txt": (raw_integers, ()),
}


def quaternions(w: World) -> str:
    rows = np.column_stack([w.p, w.R.as_quat(scalar_first=True)])
    return "x_mm,y_mm,z_mm,qw,qx,qy,qz\n" + "\n".join(",".join(f"{v:.7f}" for v in r) for r in rows) + "\n"


def kuka(w: World) -> str:
    rows = np.column_stack([w.p, w.R.as_euler("ZYX", degrees=True)])
    return "X;Y;Z;A;B;C\n" + "\n".join(";".join(number(v, 3, True) for v in r) for r in rows) + "\n"


def kuka_dat(w: World) -> str:
    rows = np.column_stack([w.p, w.R.as_euler("ZYX", degrees=True)])
    return (
        "DEFDAT P\n"
        + "\n".join(
            f"DECL E6POS XP{k + 1}={{X {r[0]:.3f},Y {r[1]:.3f},Z {r[2]:.3f},A {r[3]:.3f},B {r[4]:.3f},C {r[5]:.3f},S"
            " 2,T 35}"
            for k, r in enumerate(rows)
        )
        + "\nENDDAT\n"
    )


def bare_wpr(w: World) -> str:
    """Six numbers a row and nothing else: X, Y, Z, W, P, R of a Fanuc."""
    rows = np.column_stack([w.p, w.R.as_euler("xyz", degrees=True)])
    return "\n".join(" ".join(f"{v:.3f}" for v in r) for r in rows) + "\n"


def run(kind: str, *words: object) -> tuple[int, str, dict[str, Any]]:
    result = CliRunner().invoke(app, ["profiler", kind, *(str(w) for w in words), "--json"])
    lines = [s for s in result.stdout.splitlines() if s.startswith("{")]
    return result.exit_code, " ".join(result.output.split()), json.loads(lines[-1]) if lines else {}


def sphere(source: Path, *words: object) -> dict[str, Any]:
    code, text, found = run(
        "sphere", source, "--radius", RADIUS, "--model", "rigid", "--out", source.parent / "result", *words
    )
    assert code == 0, text
    return found


def off(found: dict[str, Any]) -> tuple[float, float]:
    """Error of X_FS: mm in the middle of the field, and degrees."""
    X = np.array(found["X_FS"])
    at = np.array([0.0, 0.0, 225.0])
    there = X[:3, :3] @ at + 1e3 * X[:3, 3]
    turn = (Rotation.from_matrix(X[:3, :3]) * R_FS.inv()).magnitude()
    return float(np.linalg.norm(there - R_FS.apply(at) - P_FS)), float(np.degrees(turn))


def check(found: dict[str, Any]) -> None:
    mm, degrees = off(found)
    assert mm < 0.2, (mm, degrees)
    assert degrees < 4.0 * found["sigma_rotation_deg"] < 2.0, (mm, degrees)


def read(source: Path, **stated: Any) -> ImportedProfiles:
    """The imported file, with its profiles compared with the world's."""
    found = import_profiles(source, **stated)
    w = world()
    assert found.profiles is not None
    assert len(found.profiles) == SCANS
    for p, z in zip(found.profiles, w.z, strict=True):
        kept, seen = np.isfinite(p).all(axis=1), np.isfinite(z)
        np.testing.assert_allclose(1e3 * p[kept, 1], z[seen], atol=6e-4)
        np.testing.assert_allclose(1e3 * p[kept, 0], w.x[seen], atol=6e-4)
    return found


def check_poses(found: ImportedProfiles, form: str = "") -> None:
    """One of the readings, or the named one, is the world's."""
    readings = [one for one in found.readings if one.form.startswith(form)]
    w = world()
    assert any(
        np.abs(1e3 * one.X[:, :3, 3] - w.p).max() < 1e-3 and np.abs(one.X[:, :3, :3] - w.R.as_matrix()).max() < 2e-4
        for one in readings
    ), [one.form for one in found.readings]


@pytest.mark.parametrize("name", FORMS)
def test_each_form_of_export_gives_the_known_pose(tmp_path: Path, name: str) -> None:
    write, words = FORMS[name]
    (tmp_path / name).write_text(write(world()), newline="")
    (tmp_path / "poses.csv").write_text(quaternions(world()))
    found = read(tmp_path / name, pitch_mm=PITCH if words else None)
    assert len(found.readings) == 1
    check_poses(found)


@pytest.mark.parametrize(
    ("name", "write"),
    [("poses.csv", kuka), ("poses.dat", kuka_dat), ("robpose.txt", bare_wpr), ("gocator_raw_poses.csv", quaternions)],
)
def test_poses_beside_an_export_in_forms_of_robots(tmp_path: Path, name: str, write: Callable[[World], str]) -> None:
    (tmp_path / "gocator_raw.csv").write_text(gocator_raw(world()), newline="")
    (tmp_path / name).write_text(write(world()))
    check_poses(read(tmp_path / "gocator_raw.csv"), "euler_xyz" if write is bare_wpr else "")


def test_rob_documents_and_opencv_documents_with_a_profile_each(tmp_path: Path) -> None:
    w = world()
    folder = tmp_path / "ScanData"
    folder.mkdir()
    for k, z in enumerate(w.z):
        cells = ", ".join(f"{a:.8e}, 0., {'.Nan' if np.isnan(v) else f'{v:.8e}'}" for a, v in zip(w.x, z, strict=True))
        (folder / f"p{k + 1}.yml").write_text(f"%YAML:1.0\n---\nscan_line: [ {cells} ]\n")
    rows = np.column_stack([w.p, w.R.as_euler("xyz", degrees=True)])
    (folder / "RobPoses.rob").write_text(json.dumps({"RobPoses": rows.tolist()}, indent=4))
    check_poses(read(folder), "euler_xyz")


@pytest.mark.parametrize("header", ["X [mm];Z [mm]", "", "X;Y;Z"])
def test_a_folder_with_one_file_per_profile(tmp_path: Path, header: str) -> None:
    w = world()
    folder = tmp_path / "set"
    folder.mkdir()
    for k, z in enumerate(w.z):
        rows = [
            f"{number(a, 3, True)};0,000;{number(v, 3, True)}" if "Y" in header else f"{number(a, 3, True)};{number(v, 3, True)}"
            for a, v in zip(w.x, z, strict=True) if np.isfinite(v)
        ]  # fmt: skip
        (folder / f"profile{k + 1}.csv").write_text("\n".join([header, *rows] if header else rows) + "\n")
    (folder / "robot_poses.csv").write_text(kuka(w))
    found = read(folder)
    assert found.readings[0].form == "euler_ZYX,deg"
    check_poses(found)


def test_poses_and_profiles_in_one_table(tmp_path: Path) -> None:
    w = world()
    q, abc = w.R.as_quat(scalar_first=True), w.R.as_euler("ZYX", degrees=True)
    for name, header, turn in (
        ("q", "qw,qx,qy,qz", q),
        ("abc", "a_deg,b_deg,c_deg", abc),
        ("wpr", "rx_deg,ry_deg,rz_deg", abc[:, ::-1]),
    ):
        rows = [f"scan,x_mm,y_mm,z_mm,{header},px_mm,pz_mm"]
        for k, z in enumerate(w.z):
            pose = ",".join(f"{v:.6f}" for v in (*w.p[k], *turn[k]))
            rows += [f"{k},{pose},{a:.4f},{v:.4f}" for a, v in zip(w.x, z, strict=True) if np.isfinite(v)]
        (tmp_path / f"{name}.csv").write_text("\n".join(rows) + "\n")
        check_poses(read(tmp_path / f"{name}.csv"))
        without = [",".join(r.split(",")[1:]) for r in rows]
        (tmp_path / f"{name}_without.csv").write_text("\n".join(without) + "\n")
        check_poses(read(tmp_path / f"{name}_without.csv"))


def test_profiles_pair_with_poses_by_number(tmp_path: Path) -> None:
    w = world()
    (tmp_path / "scancontrol_table.csv").write_text(scancontrol_table(w))
    rows = quaternions(w).splitlines()
    named = ["id," + rows[0], *(f"{k},{r}" for k, r in enumerate(rows[1:]))]
    shuffled = [named[0], *named[:0:-1]]
    (tmp_path / "poses.csv").write_text("\n".join(shuffled) + "\n")
    check_poses(read(tmp_path / "scancontrol_table.csv"))


def test_a_profile_without_a_pose_of_its_number_is_named(tmp_path: Path) -> None:
    w = world()
    (tmp_path / "scancontrol_table.csv").write_text(scancontrol_table(w))
    rows = quaternions(w).splitlines()
    (tmp_path / "poses.csv").write_text("\n".join(["id," + rows[0], *(f"{k},{r}" for k, r in enumerate(rows[2:], 1))]))
    found = import_profiles(tmp_path / "scancontrol_table.csv")
    assert found.reading["robot"]["left_out"] == ["0 of scancontrol_table.csv: It has no partner."]
    assert len(found.readings[0].X) == SCANS - 1


def test_points_in_any_order_keep_their_poses(tmp_path: Path) -> None:
    rows = [f"{k},{100.0 * k},0,500,1,0,0,0,{k},{200 + k}" for k in (4, 2, 0, 3, 1)]
    (tmp_path / "a.csv").write_text("scan,x_mm,y_mm,z_mm,qw,qx,qy,qz,px_mm,pz_mm\n" + "\n".join(rows) + "\n")
    found = import_profiles(tmp_path / "a.csv")
    assert found.profiles is not None
    x = np.array([p[0, 0] for p in found.profiles])
    np.testing.assert_allclose(found.readings[0].X[:, 0, 3], 100.0 * x)


def test_a_refusal_names_the_columns_and_its_advice_works(tmp_path: Path) -> None:
    (tmp_path / "export.csv").write_text(gocator_raw(world()), newline="")
    code, text, _ = run("sphere", tmp_path / "export.csv", "--radius", RADIUS)
    assert code == 1, text
    assert "Frame, Source, Time" in text
    assert "x_mm,y_mm,z_mm,qw,qx,qy,qz" in text
    (tmp_path / "other.csv").write_text(quaternions(world()))
    check_poses(read(tmp_path / "export.csv", poses=tmp_path / "other.csv"))
    (tmp_path / "poses.csv").write_text(quaternions(world()))
    check(sphere(tmp_path / "export.csv"))


def test_heights_without_x_are_refused_with_two_ways_that_work(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(quaternions(world()))
    source = tmp_path / "heights.csv"
    source.write_text(heights_only(world()))
    code, text, _ = run("sphere", source, "--radius", RADIUS)
    assert code == 1, text
    assert "--as pitch=" in text
    assert "first row" in text
    check(sphere(source, "--as", f"pitch={PITCH}"))
    source.write_text(heights_with_x(world()))
    check_poses(read(source))


def test_other_counts_of_poses_and_profiles_are_refused(tmp_path: Path) -> None:
    (tmp_path / "export.csv").write_text(gocator_raw(world()), newline="")
    (tmp_path / "poses.csv").write_text("\n".join(quaternions(world()).splitlines()[:-3]) + "\n")
    code, text, _ = run("sphere", tmp_path / "export.csv", "--radius", RADIUS)
    assert code == 1, text
    assert f"{SCANS - 3} poses" in text
    assert f"'export.csv' holds {SCANS};" in text


def test_unnamed_columns_are_refused_with_an_example_that_works(tmp_path: Path) -> None:
    w = world()
    source = tmp_path / "table.csv"
    rows = [
        [k, *w.p[k], *w.R[k].as_quat(scalar_first=True), a, v]
        for k, z in enumerate(w.z)
        for a, v in zip(w.x, z, strict=True)
        if np.isfinite(v)
    ]
    body = "\n".join(",".join(f"{v:.6f}" for v in r) for r in rows) + "\n"
    source.write_text("scan,x_mm,y_mm,z_mm,qw,qx,qy,qz,along,depth\n" + body)
    code, text, _ = run("sphere", source, "--radius", RADIUS)
    assert code == 1, text
    assert "along, depth" in text
    example = next(word for word in text.replace(".", " ").split() if word.startswith("scan,x_mm"))
    source.write_text(example + "\n" + body)
    check_poses(read(source))


def test_a_stated_form_wins_and_a_wrong_one_does_not_calibrate(tmp_path: Path) -> None:
    (tmp_path / "export.csv").write_text(gocator_raw(world()), newline="")
    (tmp_path / "poses.txt").write_text(bare_wpr(world()))
    check(sphere(tmp_path / "export.csv", "--as", "robot-form=euler_xyz,deg"))
    code, text, _ = run(
        "sphere",
        tmp_path / "export.csv",
        "--radius",
        RADIUS,
        "--as",
        "robot-form=euler_XYZ,deg",
        "--out",
        tmp_path / "no",
    )
    assert code != 0, text


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("axes", ["XYZ", "ZYZ"])
def test_the_profiles_choose_the_reading(tmp_path: Path, seed: int, axes: str) -> None:
    w = world(seed)
    (tmp_path / "export.csv").write_text(gocator_raw(w), newline="")
    rows = np.column_stack([w.p, w.R.as_euler(axes, degrees=True)])
    (tmp_path / "poses.csv").write_text(
        "x_mm,y_mm,z_mm,rx,ry,rz\n" + "\n".join(",".join(f"{v:.4f}" for v in r) for r in rows) + "\n"
    )
    found = import_profiles(tmp_path / "export.csv")
    assert found.profiles is not None
    assert len(found.readings) > 20
    few = [
        one
        for one in found.readings
        if one.form.partition(",")[0] in ("rotation_vector", "euler_xyz", "euler_XYZ", "euler_ZYZ")
    ]
    k, sentence = choose_reading(few, sphere_fit(found.profiles, 1e-3 * RADIUS), "sphere")
    np.testing.assert_allclose(few[k].X[:, :3, :3], w.R.as_matrix(), atol=1e-4)
    assert "the next best reading leaves" in sentence or "fit no sphere" in sentence


def test_two_readings_that_agree_are_refused_by_name(tmp_path: Path) -> None:
    w = world()
    (tmp_path / "export.csv").write_text(gocator_raw(w), newline="")
    rows = np.column_stack([w.p, w.R.as_quat()])
    (tmp_path / "poses.txt").write_text("\n".join(" ".join(f"{v:.6f}" for v in r) for r in rows) + "\n")
    found = import_profiles(tmp_path / "export.csv")
    assert [one.form for one in found.readings] == ["quaternion_xyzw", "quaternion_wxyz"]

    def alike(poses: FlangePoses) -> ReadingFit:
        return ReadingFit(np.full(SCANS, 1e-9), 3, 9, poses.rotation[0], np.zeros(3))

    with pytest.raises(InconsistentData, match="--as robot-form=quaternion_xyzw or --as robot-form=quaternion_wxyz"):
        choose_reading(found.readings, alike, "sphere")
    check_poses(read(tmp_path / "export.csv", form="quaternion_xyzw"))


@pytest.mark.parametrize(
    ("write", "old", "new", "sentence"),
    [
        (gocator_uniform, "Axis,-11.8000,", "Axis,-11,8000,", "states 60 columns and names 61"),
        (scancontrol_table, "\n0;", "\n1.558,0;", "line 3, holds words"),
    ],
)
def test_a_comma_too_many_is_refused(
    tmp_path: Path, write: Callable[[World], str], old: str, new: str, sentence: str
) -> None:
    text = write(world())
    assert old in text
    (tmp_path / "a.csv").write_text(text.replace(old, new, 1))
    (tmp_path / "poses.csv").write_text(quaternions(world()))
    with pytest.raises(InputError, match=sentence):
        import_profiles(tmp_path / "a.csv")


def test_a_row_of_a_gocator_with_one_cell_more_is_refused(tmp_path: Path) -> None:
    rows = gocator_raw(world()).replace("\r", "").split("\n")
    k = next(k for k, row in enumerate(rows) if ",Z," in row)
    short = [",".join([*row.split(",")[:-1], ""]) if j == k else row for j, row in enumerate(rows)]
    (tmp_path / "poses.csv").write_text(quaternions(world()))
    (tmp_path / "a.csv").write_text("\n".join(short))
    import_profiles(tmp_path / "a.csv")
    cells = short[k].split(",")
    at = next(j for j, c in enumerate(cells) if "." in c)
    cells[at] = cells[at].replace(".", ",")
    (tmp_path / "a.csv").write_text("\n".join([*rows[:k], ",".join(cells), *rows[k + 1 :]]))
    with pytest.raises(InputError, match="cells, and its header 69"):
        import_profiles(tmp_path / "a.csv")
