"""A scan over the robot's shape: distances against rays that were cast by hand at boxes, and the command."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

from tests.browser import Browser
from tests.places import ROOT, SHARED_DATA, needs
from weldcal.calibration.recorded_overlay import compare, overlay
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arms.shape import arm_shape
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app
from weldcal.tools.dashboard.scan_overlay import scan_page
from weldcal.tools.recorded import calibrate_dataset

AUBO = SHARED_DATA / "flange" / "aubo_i5_phoxi_s"
NOISE_M, OFF_M = 1e-4, 3e-3
Q = np.array([0.4, -0.5, 0.7, 0.3, -0.4, 0.2])
# Each link: its joint's pose in the link before (xyz, axis of the angle), the box's middle in the link, and its size.
LINKS = {
    "one": ((0.0, 0.0, 0.20), 2, (0.0, 0.0, 0.05), (0.16, 0.12, 0.10)),
    "two": ((0.0, 0.0, 0.15), 1, (0.15, 0.0, 0.0), (0.30, 0.10, 0.08)),
    "three": ((0.35, 0.0, 0.0), 1, (0.06, 0.0, 0.0), (0.12, 0.14, 0.09)),
    "four": ((0.16, 0.0, 0.0), 0, (0.0, 0.0, 0.02), (0.06, 0.06, 0.10)),
    "five": ((0.08, 0.0, 0.02), 1, (0.01, 0.0, 0.0), (0.07, 0.08, 0.06)),
    "six": ((0.08, 0.0, 0.0), 0, (0.06, 0.0, 0.0), (0.12, 0.14, 0.09)),
}
BASE_BOX = ((0.0, 0.0, 0.08), (0.2, 0.2, 0.16))
X_6F = np.array([[0.0, 0, 1, 0.12], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])


def turn(axis: int, angle: float) -> Array:
    """A rotation about x, y or z, written out."""
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    X = np.eye(4)
    X[a, a] = X[b, b] = np.cos(angle)
    X[a, b], X[b, a] = -np.sin(angle), np.sin(angle)
    return X


def moved(*xyz: float) -> Array:
    """A translation."""
    X = np.eye(4)
    X[:3, 3] = xyz
    return X


def boxes(q: Array) -> tuple[list[tuple[Array, Array]], Array]:
    """The boxes' poses in B with their sizes, the base's first, and the pose of the flange."""
    found = [(moved(*BASE_BOX[0]), np.array(BASE_BOX[1]))]
    X = np.eye(4)
    for (xyz, axis, middle, size), angle in zip(LINKS.values(), q, strict=True):
        X = X @ moved(*xyz) @ turn(axis, angle)
        found.append((X @ moved(*middle), np.array(size)))
    return found, X @ X_6F


def looking(eye: Array, at: Array) -> Array:
    """The pose of a camera at ``eye`` whose z points at ``at``."""
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, [0.1, 0.9, 0.2])
    x /= np.linalg.norm(x)
    X = np.eye(4)
    X[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    X[:3, 3] = eye
    return X


def cast(X_BC: Array, n: int = 260) -> tuple[Array, Array, Array]:
    """Points (n, n, 3) m of C with noise, and of each the box (-1: the floor) and its normal in B, by slabs."""
    u = np.linspace(-0.45, 0.45, n)
    ray = np.stack([*np.meshgrid(u, u), np.ones((n, n))], axis=-1).reshape(-1, 3)
    best, owner, normal = np.full(len(ray), np.inf), np.full(len(ray), -2), np.zeros((len(ray), 3))
    direction = ray @ X_BC[:3, :3].T
    t = (-0.1 - X_BC[2, 3]) / direction[:, 2]  # a floor below the robot
    best[t > 0], owner[t > 0] = t[t > 0], -1
    for k, (X, size) in enumerate(boxes(Q)[0]):
        o, d = X[:3, :3].T @ (X_BC[:3, 3] - X[:3, 3]), direction @ X[:3, :3]
        low, high = (-0.5 * size - o) / d, (0.5 * size - o) / d
        enter, leave = np.minimum(low, high), np.maximum(low, high)
        t, axis = enter.max(axis=1), enter.argmax(axis=1)
        hit = (t > 0) & (t < leave.min(axis=1)) & (t < best)
        best[hit], owner[hit] = t[hit], k
        normal[hit] = -np.sign(d[hit, axis[hit]])[:, None] * X[:3, :3].T[axis[hit]]
    rng = np.random.default_rng(5)
    length = np.linalg.norm(ray, axis=1)
    best = best + NOISE_M * rng.standard_normal(len(ray)) / length
    points = np.where(np.isfinite(best), best, np.nan)[:, None] * ray
    return points.reshape(n, n, 3), owner, normal


def stl(path: Path, size: tuple[float, ...]) -> None:
    """A box about the origin in millimetres, as ASCII STL."""
    corners = 500.0 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    text = ["solid box"]
    for a, b, c, d in faces:
        for triangle in ((a, b, c), (a, c, d)):
            vertices = "\n".join("vertex " + " ".join(f"{v:.6f}" for v in corners[k]) for k in triangle)
            text.append(f"facet normal 0 0 0\nouter loop\n{vertices}\nendloop\nendfacet")
    path.write_text("\n".join([*text, "endsolid box\n"]))


def write_arm(folder: Path) -> Path:
    """An arm of boxes: the base by the URDF's own box, the links by STL files in millimetres."""
    (folder / "mine" / "meshes").mkdir(parents=True)
    axes = "1 0 0", "0 1 0", "0 0 1"
    text = [
        '<robot name="mine"><link name="base"><visual><origin xyz="{} {} {}"/>'.format(*BASE_BOX[0])
        + '<geometry><box size="{} {} {}"/></geometry></visual></link>'.format(*BASE_BOX[1])
    ]
    before = "base"
    for name, (xyz, axis, middle, size) in LINKS.items():
        stl(folder / "mine" / "meshes" / f"{name}.stl", size)
        mesh = f'<mesh filename="package://mine/meshes/{name}.stl" scale="0.001 0.001 0.001"/>'
        text.append(
            f'<link name="{name}"><visual><geometry><mesh filename="package://mine/meshes/{name}.dae"/></geometry>'
            '</visual><collision><origin xyz="{} {} {}"/>'.format(*middle)
            + f'<geometry>{mesh}</geometry></collision></link><joint name="j_{name}" type="revolute">'
            + '<origin xyz="{} {} {}"/>'.format(*xyz)
            + f'<parent link="{before}"/><child link="{name}"/><axis xyz="{axes[axis]}"/>'
            '<limit lower="-3" upper="3" velocity="1" effort="1"/></joint>'
        )
        before = name
    text.append(
        '<link name="tool0"/><joint name="f" type="fixed"><origin xyz="0.12 0 0" rpy="0 1.5707963267948966 0"/>'
        '<parent link="six"/><child link="tool0"/></joint></robot>'
    )
    (folder / "mine" / "arm.urdf").write_text("\n".join(text))
    return folder / "mine" / "arm.urdf"


def quaternion(R: Array) -> list[float]:
    """wxyz, by the trace; the poses here turn by less than 180 degrees."""
    w = 0.5 * np.sqrt(1.0 + np.trace(R))
    v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4.0 * w)
    return [float(w), *map(float, v)]


def write_scan(
    folder: Path, points: Array, configuration: str = "eye_on_base", q: Array = Q, X: Array | None = None
) -> Path:
    """A dataset of one scan, 'a'; ``q`` may be empty."""
    (folder / "clouds").mkdir(parents=True)
    np.savez(folder / "clouds" / "a.npz", points=points)
    X = boxes(Q)[1] if X is None else X
    names = [f"q{k + 1}" for k in range(len(q))]
    with (folder / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["id", "x", "y", "z", "qw", "qx", "qy", "qz", *names])
        rows.writerow(["a", *X[:3, 3], *quaternion(X[:3, :3]), *q])
    header = {"schema": 1, "robot": "", "flange": "iso9409-1-50-4-m6", "configuration": configuration}
    (folder / "dataset.yaml").write_text(yaml.safe_dump(header | {"units": {"clouds": "m", "poses": "m"}}))
    return folder


def write_result(folder: Path, X: Array, symbol: str = "X_BC", **more: object) -> Path:
    """A calibration.yaml with a pose."""
    folder.mkdir()
    pose = {"matrix": X.tolist()}
    configuration = "eye_on_base" if symbol == "X_BC" else "eye_in_hand"
    document = {"schema": 1, "configuration": configuration, symbol: pose, **more}
    (folder / "calibration.yaml").write_text(yaml.safe_dump(document))
    return folder


X_BC = looking(np.array([0.9, -0.7, 1.1]), np.array([0.25, 0.05, 0.3]))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Array, Array]:
    """A folder with the arm and the dataset, and of each point the box and the normal."""
    folder = tmp_path_factory.mktemp("scene")
    points, owner, normal = cast(X_BC)
    write_arm(folder)
    write_scan(folder / "data", points)
    seen = np.isfinite(points.reshape(-1, 3)).all(axis=1)
    return folder, owner[seen], normal[seen]


def urdf(folder: Path) -> str:
    return str(folder / "mine" / "arm.urdf")


def test_a_right_calibration_shows_the_noise_only(scene: tuple[Path, Array, Array], tmp_path: Path) -> None:
    folder, owner, _ = scene
    found = overlay(write_result(tmp_path / "right", X_BC), folder / "data", "a", urdf(folder))
    assert found.note == ""
    assert ((found.body >= 0) == (owner >= 0)).mean() > 0.999
    assert [body.name for body in found.bodies] == ["base", *LINKS, "flange"]
    for k, name in enumerate(("base", *LINKS)):
        row = found.rows[name]
        assert row["points"] == pytest.approx((owner == k).sum(), rel=0.03), name
        assert abs(row["signed_mm"]) < 0.02, name
        # half of normal noise lies within 0.67 sigma along the ray, of which the normal takes a part
        assert 0.3 * 1e3 * NOISE_M < row["median_mm"] < 0.68 * 1e3 * NOISE_M, name
        assert row["p95_mm"] < 2.1 * 1e3 * NOISE_M, name


def test_an_offset_shows_by_its_part_along_each_face(scene: tuple[Path, Array, Array], tmp_path: Path) -> None:
    folder, owner, normal = scene
    for sign in (1.0, -1.0):
        wrong = write_result(tmp_path / f"wrong{sign}", moved(0.0, 0.0, sign * OFF_M) @ X_BC)
        found = overlay(wrong, folder / "data", "a", urdf(folder))
        faces = {(k, *np.round(n, 6)) for k, n in zip(owner[owner >= 0], normal[owner >= 0], strict=True)}
        assert len(faces) >= 8
        for k, *n in faces:
            face = (owner == k) & (np.abs(normal - n) < 1e-5).all(axis=1)
            if face.sum() > 200:
                expected = sign * 1e3 * OFF_M * n[2]
                # points by an edge may be nearest to another face
                assert np.nanmedian(1e3 * found.distance[face]) == pytest.approx(expected, abs=0.05)
        tops = (owner == 0) & (normal[:, 2] > 0.99)
        assert np.nanmedian(1e3 * found.distance[tops]) == pytest.approx(sign * 3.0, abs=0.05)


def test_a_scanner_on_the_flange_sees_the_base(scene: tuple[Path, Array, Array], tmp_path: Path) -> None:
    folder, _, _ = scene
    X_BF = boxes(Q)[1]
    points, owner, _ = cast(X_BC)
    data = write_scan(tmp_path / "data", points, "eye_in_hand")
    found = overlay(write_result(tmp_path / "r", np.linalg.inv(X_BF) @ X_BC, "X_FC"), data, None, urdf(folder))
    assert found.rows["base"]["points"] == pytest.approx((owner == 0).sum(), rel=0.03)
    assert found.rows["robot"]["p95_mm"] < 0.25
    with pytest.raises(
        InputError, match=r"scans of eye_in_hand, and .* is of eye_on_base: give the result of this dataset"
    ):
        overlay(write_result(tmp_path / "other", X_BC), data, None, urdf(folder))


def test_the_scanner_correction_is_applied(scene: tuple[Path, Array, Array], tmp_path: Path) -> None:
    folder, _, _ = scene
    data = write_scan(tmp_path / "data", cast(X_BC)[0] / 1.005)
    correction = {"scale": 1.005, "gradient_per_m": [0.0, 0.0]}
    corrected = write_result(tmp_path / "corrected", X_BC, scanner_correction=correction)
    assert overlay(corrected, data, None, urdf(folder)).rows["robot"]["p95_mm"] < 0.25
    plain = write_result(tmp_path / "plain", X_BC)
    assert overlay(plain, data, None, urdf(folder)).rows["robot"]["median_mm"] > 1.0


def test_links_and_flange_follow_the_kinematics_of_the_result(tmp_path: Path) -> None:
    q = np.array([0.3, -1.2, 1.1, -1.0, -1.5, 0.4])
    text = (ROOT / "models" / "arms" / "ur10e" / "default_kinematics.yaml").read_text()
    kinematics = yaml.safe_load(text)
    kinematics["kinematics"]["shoulder"]["z"] += 0.005
    X_BF = np.array(forward_kinematics(load_arm("ur10e"), q).GetAsMatrix4())
    angle = np.linspace(0.0, 2.0 * np.pi, 500)
    ring = np.column_stack([0.018 * np.cos(angle), 0.018 * np.sin(angle), 0.0 * angle, 1.0 + 0.0 * angle])
    truly = ring @ (moved(0.0, 0.0, 0.005) @ X_BF).T  # on the flat face of the flange, 5 mm above the nominal arm's
    X = looking(X_BF[:3, 3] + 0.7 * X_BF[:3, 2], X_BF[:3, 3])
    data = write_scan(tmp_path / "data", (truly @ np.linalg.inv(X).T)[:, :3], q=q, X=X_BF)
    own = write_result(tmp_path / "own", X, robot="ur10e", kinematics_file="arm.yaml")
    (own / "arm.yaml").write_text(yaml.safe_dump(kinematics))
    found = overlay(own, data)
    assert np.abs(found.distance).max() < 1e-4
    nominal = overlay(write_result(tmp_path / "nominal", X, robot="ur10e"), data)
    assert np.median(np.abs(nominal.distance)) > 0.001  # the sides are nearer than 5 mm


def test_a_known_arm_is_its_drawn_tubes() -> None:
    arm, q = load_arm("ur10e"), np.zeros(6)
    bodies = arm_shape(arm, q)
    # at zero the forearm lies along -x of the base, in the plane y = -0.174 m of wrist 1 less its tube's offset
    X = bodies[3].X_BL
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    for off in (1e-3, -1e-3):
        r = arm.housings.forearm_tube + off
        ring = np.column_stack([np.full(40, -0.3), r * np.cos(angle), arm.tube_offsets[1] + r * np.sin(angle)])
        distance, body = compare(np.asarray(X.multiply(ring.T).T), bodies)
        assert (body == 3).all()
        np.testing.assert_allclose(distance, off, atol=2e-5)


def view(*words: object) -> Result:
    return CliRunner().invoke(app, ["view", *map(str, words), "--no-browser"])


def test_the_command_writes_a_page_and_a_picture(
    scene: tuple[Path, Array, Array], tmp_path: Path, browser: Browser
) -> None:
    folder, _, _ = scene
    result = write_result(tmp_path / "result", X_BC)
    done = view(result, folder / "data", "--scan", "a", "--robot", urdf(folder), "--out", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert summary["bodies"]["two"]["median_mm"] < 0.1
    assert summary["pages"] == [str(tmp_path / "out" / "overlay.html")]
    assert (tmp_path / "out" / "overlay.png").read_bytes().startswith(b"\x89PNG")
    browser.open(tmp_path / "out" / "overlay.html", wait_for="document.querySelector('canvas')")
    text = browser.text()
    assert "Scan a: distance, mm" in text
    assert "inside 0.2 mm" in text
    assert f"two\t{summary['bodies']['two']['points']}\t" in text
    assert browser.console_messages() == []
    assert browser.outside_addresses() == []


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("no_scan", "has no scan 'b': it has a."),
        ("no_result", "There is no calibration in '"),
        ("no_folder", "There is no file or folder '"),
        (
            "no_joints",
            "The scans have no joint angles (q1, q2 ...), by which --robot places the links: add them, or omit --robot.",
        ),
        (
            "other_joints",
            "put the flange of 'arm.urdf' 20 mm from its recorded pose: give them in rad, and name the arm",
        ),
        ("no_mesh", "has no mesh of 'two' that can be read: put STL, OBJ or PLY files beside it, by the names in it."),
        ("no_scale", "'one.stl' is 160 m wide: give it scale=\"0.001 0.001 0.001\" in 'arm.urdf'."),
        ("no_robot", "Robot '' is not known"),
        ("elsewhere", "No point of scan 'a' lies within 20 mm of the robot"),
        ("no_dataset", "--scan, --robot and --out are for a scan: give its dataset after the result."),
    ],
)
def test_a_mistake_is_one_sentence(
    scene: tuple[Path, Array, Array], tmp_path: Path, change: str, sentence: str
) -> None:
    folder, _, _ = scene
    shutil.copytree(folder / "mine", tmp_path / "mine")
    data, robot = folder / "data", ["--robot", urdf(tmp_path)]
    X = moved(5.0, 0.0, 0.0) @ X_BC if change == "elsewhere" else X_BC
    result = tmp_path / "result"
    if change == "no_result":
        result.mkdir()
    elif change != "no_folder":
        write_result(result, X)
    if change == "no_joints":
        data = write_scan(tmp_path / "data", cast(X_BC, 40)[0], q=np.array([]))
    if change == "other_joints":
        data = write_scan(tmp_path / "data", cast(X_BC, 40)[0], X=moved(0.0, 0.0, 0.02) @ boxes(Q)[1])
    if change == "no_mesh":
        (tmp_path / "mine" / "meshes" / "two.stl").unlink()
    if change == "no_scale":
        text = (tmp_path / "mine" / "arm.urdf").read_text()
        (tmp_path / "mine" / "arm.urdf").write_text(text.replace('scale="0.001 0.001 0.001"', ""))
    words = [result, *([] if change == "no_dataset" else [data]), *([] if change == "no_robot" else robot)]
    refused = view(*words, "--scan", "b" if change == "no_scan" else "a", "--out", tmp_path / "out")
    assert refused.exit_code == 1, refused.stdout
    assert sentence in " ".join(refused.stderr.split())
    assert refused.stderr.count("\n") <= 3
    assert not (tmp_path / "out").exists()


@needs(AUBO)
def test_a_real_scan_lies_on_its_flange(tmp_path: Path) -> None:
    calibrate_dataset(AUBO, tmp_path / "result")
    done = view(tmp_path / "result", AUBO, "--scan", "pose10", "--out", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert summary["points"] > summary["bodies"]["robot"]["points"] == summary["bodies"]["flange"]["points"] > 8000
    assert summary["bodies"]["flange"]["median_mm"] < 0.2  # the held-out errors of this set
    assert "only the flange's face is compared" in done.stderr
    missing = view(tmp_path / "result", AUBO, "--scan", "pose99", "--out", tmp_path / "other")
    assert missing.exit_code == 1
    assert "has no scan 'pose99'" in missing.stderr


def test_a_name_of_a_link_is_no_markup(scene: tuple[Path, Array, Array], tmp_path: Path) -> None:
    folder, _, _ = scene
    found = overlay(write_result(tmp_path / "r", X_BC), folder / "data", "a", urdf(folder))
    object.__setattr__(found.bodies[0], "name", "<b>base")
    assert "&lt;b&gt;base" in scan_page(found)
