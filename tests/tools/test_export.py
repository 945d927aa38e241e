"""weldcal export: what ROS 2 and Drake read from its files is the calibrated pose, in the frames that they name."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import LoadModelDirectives, Parser, ProcessModelDirectives
from pydrake.multibody.plant import MultibodyPlant
from pydrake.visualization import ModelVisualizer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from weldcal.calibration.data.results import CalibrationResult, save_result
from weldcal.tools.cli.app import app

X_C = RigidTransform(RollPitchYaw(3.0, 0.2, 0.7), [-0.6, -0.3, 1.1])
P_C = np.array([0.1, -0.2, 0.9])  # a scanned point

# A tree of frames as a UR driver and a camera driver publish it: (parent, child): roll, pitch, yaw and xyz.
TF = {
    ("base_link", "base"): ((0.0, 0.0, np.pi), (0.0, 0.0, 0.0)),
    ("wrist_3_link", "flange"): ((0.0, -np.pi / 2, -np.pi / 2), (0.0, 0.0, 0.0)),
    ("flange", "tool0"): ((np.pi / 2, 0.0, np.pi / 2), (0.0, 0.0, 0.0)),
    ("camera_link", "camera_color_optical_frame"): ((-np.pi / 2, 0.0, -np.pi / 2), (0.0, 0.015, 0.0)),
}


def edge(parent: str, child: str) -> np.ndarray:
    """The transform (4, 4) of TF from child to parent."""
    rpy, xyz = TF[parent, child]
    return transform(Rotation.from_euler("xyz", rpy), np.array(xyz))


def transform(R: Rotation, p: np.ndarray) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R.as_matrix(), p
    return X


@dataclass(frozen=True)
class Node:
    """In place of launch_ros.actions.Node: what it was made with."""

    arguments: list[str]
    package: str
    executable: str
    name: str
    output: str


def published(folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, str, np.ndarray]:
    """Parent, child and transform (4, 4) that the launch file publishes; the shell line publishes the same."""
    launch, launch_ros, actions = (ModuleType(name) for name in ("launch", "launch_ros", "launch_ros.actions"))
    launch.LaunchDescription = list  # type: ignore[attr-defined]
    actions.Node = Node  # type: ignore[attr-defined]
    for module in (launch, launch_ros, actions):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    scope: dict[str, Any] = {}
    exec(compile((folder / "scanner.launch.py").read_text(), "scanner.launch.py", "exec"), scope)
    (node,) = scope["generate_launch_description"]()
    assert (node.package, node.executable) == ("tf2_ros", "static_transform_publisher")
    line = (folder / "static_transform.sh").read_text().splitlines()[-1]
    assert line.split() == ["ros2", "run", node.package, node.executable, *node.arguments]
    given = dict(zip(node.arguments[::2], node.arguments[1::2], strict=True))
    R = Rotation.from_quat([float(given[f"--q{k}"]) for k in "xyzw"])
    return (
        given["--frame-id"],
        given["--child-frame-id"],
        transform(R, np.array([float(given[f"--{k}"]) for k in "xyz"])),
    )


def result_of(folder: Path, robot: str = "ur10e", configuration: str = "eye_on_base", **more: Any) -> Path:
    """The folder of a calibration with the pose X_C."""
    save_result(
        CalibrationResult(
            X_BC=X_C,
            covariance=1e-8 * np.eye(6),
            held_out_mm={"median": 0.1},
            tilt_deg={},
            poses=(),
            robot=robot,
            configuration=configuration,
            **more,
        ),
        folder / "result",
    )
    return folder / "result"


def export(*words: object, code: int = 0) -> str:
    """Runs the command; its stdout, or its one sentence on stderr."""
    finished = CliRunner().invoke(app, ["export", *map(str, words)])
    assert finished.exit_code == code, finished.stderr
    return finished.stdout if code == 0 else finished.stderr


def test_a_point_is_at_the_same_place_in_base_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(result_of(tmp_path), "--ros2", tmp_path / "ros")
    parent, child, X = published(tmp_path / "ros", monkeypatch)
    assert (parent, child) == ("base_link", "scanner_optical_frame")
    p_B = X_C @ P_C
    assert np.allclose((X @ [*P_C, 1.0])[:3], (edge("base_link", "base") @ [*p_B, 1.0])[:3], atol=1e-8)
    assert np.linalg.norm(p_B - (X @ [*P_C, 1.0])[:3]) > 0.5  # base and base_link are told apart


@pytest.mark.parametrize("parent", ["base", "cell_table"])
def test_another_parent_gets_the_pose_as_it_is(parent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(result_of(tmp_path), "--ros2", tmp_path, "--parent", parent, "--child", "cam/optical")
    assert published(tmp_path, monkeypatch)[:2] == (parent, "cam/optical")
    assert np.allclose(published(tmp_path, monkeypatch)[2], X_C.GetAsMatrix4(), atol=1e-8)


def test_poses_from_tf_need_no_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(result_of(tmp_path), "--ros2", tmp_path, "--from-tf")
    parent, _, X = published(tmp_path, monkeypatch)
    assert parent == "base_link"
    assert np.allclose(X, X_C.GetAsMatrix4(), atol=1e-8)


@pytest.mark.parametrize("parent", ["", "flange", "wrist_3_link", "left_flange"])
def test_a_carried_scanner_is_at_the_flange(parent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(
        result_of(tmp_path, configuration="eye_in_hand"), "--ros2", tmp_path, *(["--parent", parent] if parent else [])
    )
    found, _, X = published(tmp_path, monkeypatch)
    assert found == (parent or "tool0")
    above = {"": np.eye(4), "wrist_3_link": edge("wrist_3_link", "flange") @ edge("flange", "tool0")}
    X_parent_tool0 = above.get(parent, edge("flange", "tool0"))
    assert np.allclose(X, X_parent_tool0 @ X_C.GetAsMatrix4(), atol=1e-8)
    assert "EYE-IN-HAND: " + found in (tmp_path / "scanner.launch.py").read_text()


@pytest.mark.parametrize("form", ["{} {} {} {} {} {} {}", "[{}, {}, {}] [{}, {}, {}, {}]"])
def test_the_frame_of_a_camera_driver_keeps_its_optical_frame(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = edge("camera_link", "camera_color_optical_frame")
    numbers = [*driver[:3, 3], *Rotation.from_matrix(driver[:3, :3]).as_quat()]
    words = ("--parent", "base", "--child", "camera_link", "--optical-pose", form.format(*numbers))
    export(result_of(tmp_path), "--ros2", tmp_path, *words)
    _, child, X = published(tmp_path, monkeypatch)
    assert child == "camera_link"
    assert np.allclose(X @ driver, X_C.GetAsMatrix4(), atol=1e-8)


def test_the_xacro_file_has_the_same_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(result_of(tmp_path), "--ros2", tmp_path)
    origin = ElementTree.parse(tmp_path / "scanner.urdf.xacro").getroot().find("joint/origin")
    assert origin is not None
    rpy, xyz = (np.array(origin.attrib[key].split(), float) for key in ("rpy", "xyz"))
    X = transform(Rotation.from_euler("xyz", rpy), xyz)
    assert np.allclose(X, published(tmp_path, monkeypatch)[2], atol=1e-8)


def hand_eye(path: Path, configuration: str, symbol: str) -> Path:
    """A result of hand-eye, which names no robot."""
    pose = {symbol: {"matrix": X_C.GetAsMatrix4().tolist()}}
    path.write_text(json.dumps({"schema": 1, "configuration": configuration, "poses": pose}))
    return path


def test_a_hand_eye_result_is_in_the_frame_that_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = hand_eye(tmp_path / "hand_eye.yaml", "eye_in_hand", "X_FC")
    export(result, "--ros2", tmp_path, "--parent", "tool0")
    parent, _, X = published(tmp_path, monkeypatch)
    assert parent == "tool0"
    assert np.allclose(X, X_C.GetAsMatrix4(), atol=1e-8)
    export(result, "--ros2", tmp_path / "panda", "--robot", "franka_panda")
    assert published(tmp_path / "panda", monkeypatch)[0] == "panda_link8"


@pytest.mark.parametrize(("on_hand", "frame"), [(False, "base_link"), (True, "left_tool0")])
def test_the_frame_that_another_program_names_is_the_parent(
    on_hand: bool, frame: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    q = X_C.rotation().ToQuaternion()
    numbers = dict(zip(("x", "y", "z", "qw", "qx", "qy", "qz"), (*X_C.translation(), *q.wxyz()), strict=True))
    frames = {"robot_base_frame": "base_link", "robot_effector_frame": "left_tool0"}
    text = {
        "parameters": {"eye_on_hand": on_hand, **frames},
        "transformation": {k: float(v) for k, v in numbers.items()},
    }
    (tmp_path / "found.yaml").write_text(json.dumps(text))
    export(tmp_path / "found.yaml", "--ros2", tmp_path, "--robot", "ur5e")
    assert published(tmp_path, monkeypatch)[0] == frame
    assert np.allclose(published(tmp_path, monkeypatch)[2], X_C.GetAsMatrix4(), atol=1e-8)


def frame_in(plant: MultibodyPlant, frame: str, parent: str) -> np.ndarray:
    """The pose (4, 4) of one frame of a plant in another at its default positions."""
    plant.Finalize()
    context = plant.CreateDefaultContext()
    X = plant.GetFrameByName(frame).CalcPose(context, plant.GetFrameByName(parent, plant.GetModelInstanceByName("arm")))
    return np.asarray(X.GetAsMatrix4())


@pytest.mark.parametrize(("configuration", "parent"), [("eye_on_base", "base"), ("eye_in_hand", "flange")])
def test_drake_puts_the_scanner_where_it_was_calibrated(configuration: str, parent: str, tmp_path: Path) -> None:
    file = tmp_path / "a cell" / "station.dmd.yaml"
    out = export(result_of(tmp_path, configuration=configuration), "--drake-directives", file)
    assert "model_visualizer" in out
    plant = MultibodyPlant(0.0)
    ProcessModelDirectives(LoadModelDirectives(str(file)), Parser(plant))
    for frame in ("scanner_optical_frame", "scanner"):
        again = MultibodyPlant(0.0)
        ProcessModelDirectives(LoadModelDirectives(str(file)), Parser(again))
        assert np.allclose(frame_in(again, frame, parent), X_C.GetAsMatrix4(), atol=1e-8)
    assert np.allclose(frame_in(plant, "flange_face", "flange"), np.eye(4))
    assert plant.num_positions() == 6
    assert not np.allclose(plant.GetDefaultPositions(), 0.0)  # an arm at zero lies in the table


def test_drakes_model_visualizer_shows_the_station(tmp_path: Path) -> None:
    file = tmp_path / "station.dmd.yaml"
    export(result_of(tmp_path), "--drake-directives", file)
    meshcat = Meshcat(MeshcatParams(host="localhost"))
    visualizer = ModelVisualizer(meshcat=meshcat, publish_contacts=False)
    visualizer.AddModels(filename=file)
    visualizer.Run(loop_once=True)
    assert all(meshcat.HasPath(f"/drake/illustration/{name}") for name in ("arm", "flange_face", "scanner"))


def test_a_users_own_drake_model_gets_one_frame(tmp_path: Path) -> None:
    file = tmp_path / "frame.yaml"
    out = export(result_of(tmp_path), "--drake-directives", file, "--parent", "arm::base")
    assert ".dmd.yaml" in out
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString('<robot name="arm"><link name="base"/></robot>', "urdf")
    ProcessModelDirectives(LoadModelDirectives(str(file)), Parser(plant))
    assert np.allclose(frame_in(plant, "scanner_optical_frame", "base"), X_C.GetAsMatrix4(), atol=1e-8)
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["result"]


def test_every_file_says_that_points_are_corrected(tmp_path: Path) -> None:
    result = result_of(tmp_path, scanner_correction={"scale": 1.002, "gradient_per_m": [0.01, -0.01]})
    assert "corrected" in export(result, "--ros2", tmp_path / "ros")
    export(result, "--drake-directives", tmp_path / "ros" / "station.dmd.yaml")
    for path in (tmp_path / "ros").glob("s*.*"):
        assert path.is_dir() or "corrected scanner points: 'weldcal apply" in path.read_text(), path.name


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--parent", "/base"], "'/base' is no name of a frame"),
        (["--child", "base_link"], "Parent and child are the same frame 'base_link'"),
        (["--robot", "ur99"], "Robot 'ur99' is not known"),
        (["--robot", "aubo_i5"], "The tf frames of the robot 'aubo_i5' are not known: give its base with --parent"),
        (["--child", "c", "--optical-pose", "1 2 3"], "needs the seven numbers"),
        (["--child", "c", "--optical-pose", "0 0 0 0 0 0 2"], "has the length 2, not 1"),
    ],
)
def test_a_mistake_is_one_sentence(words: list[str], sentence: str, tmp_path: Path) -> None:
    said = export(result_of(tmp_path), "--ros2", tmp_path / "ros", *words, code=1)
    assert sentence in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "ros").exists()


def test_what_a_result_does_not_say_is_asked_for(tmp_path: Path) -> None:
    unnamed = hand_eye(tmp_path / "hand_eye.yaml", "eye_on_base", "X_BC")
    assert "--parent, or the robot with --robot" in export(unnamed, "--ros2", tmp_path / "ros", code=1)
    assert "names no robot: give --robot" in export(unnamed, "--drake-directives", tmp_path / "a.yaml", code=1)
    np.savetxt(tmp_path / "X.txt", X_C.GetAsMatrix4())
    assert "does not name the mounting" in export(tmp_path / "X.txt", "--ros2", tmp_path / "ros", code=1)
    bare = (tmp_path / "X.txt", "--robot", "ur10e", "--drake-directives", tmp_path / "a.yaml")
    assert "does not name the mounting" in export(*bare, code=1)
    assert "ends in .dmd.yaml" in export(unnamed, "--drake-directives", tmp_path / "a.xml", code=1)


def test_a_pose_of_another_link_needs_its_parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = hand_eye(tmp_path / "hand_eye.yaml", "eye_on_arm_target_on_base", "X_LC")
    assert "does not name the mounting" in export(result, "--ros2", tmp_path / "ros", code=1)
    export(result, "--ros2", tmp_path / "ros", "--parent", "forearm_link")
    parent, _, X = published(tmp_path / "ros", monkeypatch)
    assert parent == "forearm_link"
    assert np.allclose(X, X_C.GetAsMatrix4(), atol=1e-8)


def test_earlier_files_stay_unless_overwritten(tmp_path: Path) -> None:
    result = result_of(tmp_path)
    export(result, "--ros2", tmp_path)
    (tmp_path / "static_transform.sh").write_text("mine")
    assert "--overwrite" in export(result, "--ros2", tmp_path, code=1)
    assert (tmp_path / "static_transform.sh").read_text() == "mine"
    export(result, "--ros2", tmp_path, "--overwrite")
    assert (tmp_path / "static_transform.sh").read_text() != "mine"


@pytest.mark.parametrize(
    "words", [[], ["--ros2", "a", "--drake-directives", "b"], ["--ros2", "a", "--optical-pose", "1"]]
)
def test_wrong_usage_ends_with_2(words: list[str], tmp_path: Path) -> None:
    assert "Usage" in export(result_of(tmp_path), *words, code=2)
