"""The files that the examples name: a user has them, a check makes them, small and valid."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml
from pydrake.math import RigidTransform, RollPitchYaw
from typer.testing import CliRunner

import weldcal
from tests.calibration.hand_eye import rendering
from tests.calibration.tablet.visit import write_visit
from tests.calibration.tool import torches
from tests.documents.scans import write_scans, write_wrist_scans
from tests.places import ROOT, SHARED_DATA
from tests.short_job import SHORT_JOB
from tests.worlds.touch import touch_world
from weldcal.calibration.data.camera_file import CameraFile, camera_document
from weldcal.calibration.data.results import save_result
from weldcal.calibration.geometry.se3 import rotation_vector
from weldcal.calibration.touch.touches import touches_text
from weldcal.models.arms import ur10e
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arms.urdf import arm_urdf
from weldcal.models.mesh import extrude
from weldcal.models.scanners import get_scanner
from weldcal.models.tools.loading import WELDING
from weldcal.tools.commands.cell.new import write_cell

# An angle bracket of plates 10 mm thick; lengths in mm. Its inner corner is the longest concave edge.
ANGLE = np.array([[0.0, 0.0], [80.0, 0.0], [80.0, 10.0], [10.0, 10.0], [10.0, 60.0], [0.0, 60.0]])
SHORT_WIRED = (
    "calibration: {minimum_scans: 4, maximum_scans: 6, required_error_mm: 1.0}\nwelding: {seam_length_mm: 20.0}\n"
)
HELD_AFTER_3_S = "extends: calibrate_only\njob: {maximum_time_s: 3.0}\nscanner: {width: 412, height: 308}\n"


def random_poses(n: int, rng: np.random.Generator, turn: float = 0.6) -> list[RigidTransform]:
    """Poses in front of a robot: turned by up to `turn` about each axis, positions (m) in its working volume."""
    low, high = [0.35, -0.25, 0.25], [0.65, 0.25, 0.65]
    return [RigidTransform(RollPitchYaw(rng.uniform(-turn, turn, 3)), rng.uniform(low, high)) for _ in range(n)]


def matrices(poses: list[RigidTransform]) -> list[np.ndarray]:
    """4 x 4 matrices of poses."""
    return [X.GetAsMatrix4() for X in poses]


def _hand_eye(path: Path, mounting: str, beside_m: float = 0.0) -> None:
    """Pairs of a UR10e, with its joint angles (rad), and 0.1 mm of noise; of a camera that stands so far beside."""
    rng, arm = np.random.default_rng(3), load_arm("ur10e")
    X, Y = random_poses(2, rng)
    X = X @ RigidTransform([beside_m, 0.0, 0.0])
    q = np.deg2rad([0.0, -80.0, 110.0, -120.0, -90.0, 0.0]) + rng.uniform(-0.6, 0.6, (24, 6))
    robot = [forward_kinematics(arm, joints) for joints in q]
    in_hand = mounting == "eye_in_hand"
    camera = [(F @ X).InvertAndCompose(Y) if in_hand else X.InvertAndCompose(F @ Y) for F in robot]
    noisy = [G @ RigidTransform(RollPitchYaw(rng.normal(size=3) * 2e-4), rng.normal(size=3) * 1e-4) for G in camera]
    np.savez(path, A=matrices(robot), B=matrices(noisy), q=q, mode=mounting)


def _camera_pose(path: Path) -> None:
    """The camera's true pose of `_hand_eye` as a pose vector: position and rotation vector."""
    X = random_poses(2, np.random.default_rng(3))[0]
    vector = (*X.translation(), *rotation_vector(X.rotation()))
    path.write_text("rows: 6\ncols: 1\ndata:\n" + "".join(f"  - [{v:.9f}]\n" for v in vector), encoding="utf-8")


def _pictures(path: Path) -> None:
    """Twelve pictures of a chessboard by a camera at the flange, and the robot's poses."""
    drawing = rendering.draw_chessboard(9, 6, 25)
    found = rendering.world(drawing, 5, 12)
    rendering.write_pictures(path, drawing, found, 5, sub=2)
    rendering.write_robot(path / "poses.txt", found.robot)


def _camera(path: Path) -> None:
    """The camera of those pictures, as weldcal camera writes it."""
    of = np.diag([1.0] * 4 + [1e-4] * 4 + [0.0])
    true = CameraFile(rendering.K, np.append(rendering.DIST, 0.0), rendering.SIZE, covariance=of)
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump(camera_document(true), sort_keys=False), encoding="utf-8")


def _two_robots(path: Path) -> None:
    rng = np.random.default_rng(4)
    X, Y, Z = random_poses(3, rng)
    first, second = random_poses(20, rng), random_poses(20, rng)
    camera = [(F @ X).InvertAndCompose(Y @ G @ Z) for F, G in zip(first, second, strict=True)]
    np.savez(path, A=matrices(first), B=matrices(camera), C=matrices(second), mode="co_manipulation")


def _bracket(path: Path) -> None:
    from tests.worlds.parts.step_parts import PARTS, write_step

    write_step(PARTS["bracket"]().shape, path)


def _beam(path: Path) -> None:
    """A T of two solids, 1 m long."""
    from tests.worlds.parts.step_parts import assembly, box, write_step

    write_step(assembly(box((0, -50, 0), (1000, 100, 8)), box((0, -4, 8), (1000, 8, 92))), path)


def _bracket_scan(path: Path) -> None:
    from tests.worlds.parts.scans import scan_scene, subject

    scene = scan_scene(subject("bracket").mesh, get_scanner("phoxi_m", width=412, height=308), 0)
    np.savez(path, points_B=scene.cloud_B, eye_B=scene.eye_B)


def _scanner(path: Path) -> None:
    page = (ROOT / "docs" / "scanners.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(name: my_scanner\n.*?)```", page, re.DOTALL)
    path.write_text(text, encoding="utf-8")


def _calibration(path: Path) -> None:
    made = next(
        (path.parent / n for n in ("my-calibration", "my_result") if (path.parent / n / "X_BC.json").exists()), None
    )
    if made is not None:
        shutil.copytree(made, path)
        return
    with TemporaryDirectory() as folder:
        weldcal.calibrate(write_scans(Path(folder) / "scans", 12, 0), out=path)


def _kinematics(path: Path) -> None:
    shutil.copy(Path(ur10e.__file__).parent / "default_kinematics.yaml", path)


def _demo(path: Path) -> None:
    """The result of a demo on a short seam: a minute."""
    from weldcal.tools.cli.app import app

    path.parent.mkdir(exist_ok=True)
    scenario = path.parents[1] / "short.yaml"
    PROPS["short.yaml"](scenario)
    words = ["demo", "--no-browser", "--record", "--scenario", str(scenario), "--out", str(path)]
    assert CliRunner().invoke(app, words).exit_code == 0


def _recording(path: Path) -> None:
    with TemporaryDirectory() as folder:
        result = Path(folder) / "results" / "run"
        _demo(result)
        shutil.copy(result / path.name, path)


def _torch(name: str) -> Callable[[Path], None]:
    """Scans of a bent torch, the calibration of their scanner, or touches of its wire, all of one cell."""

    def write(path: Path) -> None:
        with TemporaryDirectory() as folder:
            torches.written(torches.cell(11, torches.Wrong(bend=2e-4), scans=8), Path(folder))
            path.parent.mkdir(exist_ok=True)
            shutil.move(Path(folder) / name, path)

    return write


def _profiler(name: str) -> Callable[[Path], None]:
    """One set of the fixed profiler files, in mm, with the names of docs/profiler.md."""

    def write(path: Path) -> None:
        source = {"edge": "edge_features", "sphere": "sphere", "groove": "groove"}[name]
        data = np.load(SHARED_DATA / "profiler" / f"{source}.npz")
        if name == "edge":
            rotation, translation, points = (data[f"grid_xy_nominal_{k}"][0] for k in ("Rb", "Tb", "ps"))
            np.savez(path, rotation=rotation, translation=translation, points=points, unit="mm")
        elif name == "groove":
            np.savez(path, T=data["T"][0], profiles=data["prof"][0], unit="mm")
        else:
            arrays = {"T": data["scan_T"][0], "profiles": data["scan_prof"][0], "touch_T": data["touch_T"][0]}
            shared = {
                "sign": data["scan_sign"][0],
                "translated": data["scan_kind"][0] == 0,
                "tip": data["tip_nominal"][0],
            }
            np.savez(path, **arrays, **shared, radius=data["radius"], unit="mm")

    return write


def _bead(path: Path) -> None:
    from tests.worlds.bead import seam

    made = seam(12, np.random.default_rng(0))
    X_FS = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    T = made.X_BS @ np.linalg.inv(X_FS)  # flange poses, for about the mounting of my-profiler
    np.savez(path, T=T, profiles=np.array(made.profiles), unit="m")


def _profiler_result(path: Path) -> None:
    from weldcal.tools.cli.app import app

    with TemporaryDirectory() as folder:
        file = Path(folder) / "sphere.npz"
        PROPS["sphere.npz"](file)
        assert CliRunner().invoke(app, ["profiler", "sphere", str(file), "--out", str(path)]).exit_code == 0


# Each file or folder by the name that the pages give it.
PROPS: dict[str, Callable[[Path], object]] = {
    "my_scans": lambda path: write_scans(path, 12, 0),
    "other_scans": lambda path: write_scans(path, 8, 1),
    "three_scans": lambda path: write_scans(path, 3, 2),
    "my_wrist_scans": write_wrist_scans,
    "one_scan": lambda path: write_scans(path, 1, 5),
    "pairs.npz": lambda path: _hand_eye(path, "eye_in_hand"),
    "eMc.yaml": _camera_pose,
    "my_pictures": _pictures,
    "my_camera/camera.yaml": _camera,
    "samples.npz": lambda path: _hand_eye(path, "eye_in_hand"),
    "fixed_camera.npz": lambda path: _hand_eye(path, "eye_on_base"),
    "camera1.npz": lambda path: _hand_eye(path, "eye_on_base"),
    "camera2.npz": lambda path: _hand_eye(path, "eye_on_base", 0.5),
    "two_robots.npz": _two_robots,
    "bracket.step": _bracket,
    "beam.step": _beam,
    "bracket_scan.npz": _bracket_scan,
    "my_arm.urdf": lambda path: path.write_text(arm_urdf(load_arm("ur10e")), encoding="utf-8"),
    "clamp.stl": lambda path: path.write_text(stl(), encoding="utf-8"),
    "my_tool.yaml": lambda path: shutil.copy(WELDING, path),
    "my_scanner.yaml": _scanner,
    "my-calibration": _calibration,
    "my-calibration/kinematics.yaml": _kinematics,
    "kinematics.yaml": _kinematics,
    "factory_calibration.yaml": _kinematics,
    "cells": lambda path: [
        write_scans(path / f"cell_{k}" / f"2026-0{m}", 6, 10 * k + m) for k in (1, 2) for m in (1, 2)
    ],
    "my_result": _calibration,
    "my_cell": lambda path: write_cell(path, "s_groove")[0],
    "short.yaml": lambda path: path.write_text(f"extends: s_groove\n{SHORT_JOB}", encoding="utf-8"),
    "short_cell.yaml": lambda path: path.write_text(f"extends: my_cell/cell.yaml\n{SHORT_JOB}", encoding="utf-8"),
    "short_wired.yaml": lambda path: path.write_text(f"extends: wired_s_groove\n{SHORT_WIRED}", encoding="utf-8"),
    "weldcal-out/demo-s_groove-seed0": _demo,
    "recording.mcap": _recording,
    "my_cell.yaml": lambda path: path.write_text(HELD_AFTER_3_S, encoding="utf-8"),
    "my_scenario.yaml": lambda path: path.write_text(f"extends: s_groove\n{SHORT_JOB}", encoding="utf-8"),
    "touches.csv": lambda path: write_visit(path.parent),
    "touched_points.csv": lambda path: path.write_text(touches_text(touch_world(20).touches), encoding="utf-8"),
    "touched-calibration": lambda path: save_result(touch_world(20).result, path),
    "shown/scans": _torch("scans"),
    "torch_result": _torch("result"),
    "wire_touches.csv": _torch("touches.csv"),
    "edge.npz": _profiler("edge"),
    "sphere.npz": _profiler("sphere"),
    "groove.npz": _profiler("groove"),
    "bead.npz": _bead,
    "my-profiler": _profiler_result,
}
# They are taken from measured and fixed data beside the checkout.
NEED_DATA = ("edge.npz", "sphere.npz", "groove.npz", "my-profiler", "../shared/data")


def needs_data(text: str) -> bool:
    """Whether what a text names is made from shared/data."""
    return any(name in text for name in NEED_DATA)


def stl() -> str:
    """The angle bracket, 150 mm long, as ASCII STL."""
    mesh = extrude(ANGLE, 0.0, 150.0)
    facets = []
    for corners in mesh.vertices[mesh.triangles]:
        rows = "\n".join(f"   vertex {x:.6g} {y:.6g} {z:.6g}" for x, y, z in corners)
        facets.append(f" facet normal 0 0 0\n  outer loop\n{rows}\n  endloop\n endfacet")
    return "\n".join(["solid angle", *facets, "endsolid angle", ""])


def named_in(text: str) -> list[str]:
    """The files that a text names and a user is expected to have."""
    words = set(re.findall(r"[\w./-]+", text))
    return [name for name in PROPS if any(name in (word, *word.split("/")) for word in words)]


def lay_out(text: str, folder: Path, but: tuple[str, ...] = ()) -> None:
    """Make the files that a text names, where they are not there yet; `but` are made by the text itself."""
    for name in named_in(text):
        if name not in but and not (folder / name).exists():
            PROPS[name](folder / name)
