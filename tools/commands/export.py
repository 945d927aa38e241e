"""Write a calibrated pose for ROS 2 (launch file, static transform, xacro) or as Drake directives: weldcal export."""

import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from weldcal.calibration.data.results import RESULT_FILE, correction_hint, export_ros2, export_urdf, software_version
from weldcal.calibration.data.stated_pose import HAND_EYE_FILE, SYMBOLS, read_stated_pose
from weldcal.calibration.hand_eye.exports import export_drake_directive
from weldcal.models.arms.kinematics import known_arms, load_arm
from weldcal.models.arms.urdf import arm_urdf
from weldcal.models.documents import read_document
from weldcal.models.errors import InputError
from weldcal.models.files import require_whole, write_atomic
from weldcal.models.flanges import flange_mesh, get_flange
from weldcal.models.robots import get_robot
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import LOOK, Call, Outcome, command, option, switch

CHILD = "scanner_optical_frame"
ARM = "arm::"  # scope of the arm in the directives of a station
UR_FRAMES = {"eye_on_base": ("base_link", "base"), "eye_in_hand": ("tool0", "wrist_3_link", "flange")}
"""Frames of Universal Robots' ROS description at the base and at the flange; the first is the usual parent."""
UR_TURNS = {
    "base_link": RotationMatrix(RollPitchYaw(0.0, 0.0, math.pi)),
    "flange": RotationMatrix(RollPitchYaw(math.pi / 2, 0.0, math.pi / 2)),
}
"""Rotation of weldcal's frame B or F in a frame of that description; `base`, `tool0` and `wrist_3_link` are B and F
themselves. Source: joints base_link-base_fixed_joint and flange-tool0 of ur_macro.xacro."""
OTHER_FRAMES = {
    "franka_panda": {"eye_on_base": "panda_link0", "eye_in_hand": "panda_link8"},
    "franka_fr3": {"eye_on_base": "fr3_link0", "eye_in_hand": "fr3_link8"},
}
"""The frames that are B and F of other robots. Source: franka_description."""
UNIT = 0.01  # a choice: how far the length of a typed quaternion may be from 1
SCANNER_URDF = """<robot name="scanner">
  <link name="scanner">
    <visual>
      <origin xyz="0 0 -0.04"/>
      <geometry><box size="0.16 0.06 0.08"/></geometry>
      <material name="body"><color rgba="0.2 0.3 0.4 1"/></material>
    </visual>
    <visual>
      <origin xyz="0 0 0.15"/>
      <geometry><cylinder radius="0.002" length="0.3"/></geometry>
      <material name="axis"><color rgba="0.1 0.4 0.9 1"/></material>
    </visual>
  </link>
</robot>
"""
"""A box behind the optical frame and a rod along its z. The sizes are a choice: calibration knows no housing."""
FLANGE_URDF = """<robot name="flange_face">
  <link name="flange_face">
    <visual>
      <geometry><mesh filename="flange_face.obj"/></geometry>
      <material name="steel"><color rgba="0.7 0.7 0.72 1"/></material>
    </visual>
  </link>
</robot>
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportedPose:
    """A calibrated pose and what its file says of it.

    Attributes:
        X: pose of the scanner's optical frame C in the robot's base B, or in its flange F.
        mounting: eye_on_base, eye_in_hand, or None where the file does not say.
        file: the file that states it.
        document: the file's content where it is a YAML or JSON mapping, else empty.
        robot: name of the robot, or empty.
        frame: the tf frame that the file states the pose in, as easy_handeye2 writes it, or empty.
    """

    X: RigidTransform
    mounting: str | None
    file: Path
    document: Mapping[str, Any]
    robot: str
    frame: str = ""

    def notes(self) -> tuple[str, ...]:
        """Sentences for a user of the pose alone."""
        symbol = SYMBOLS.get(self.mounting or "", "The pose")
        found = []
        if self.document.get("scanner_correction") is not None:
            found.append(correction_hint(symbol, self.file))
        if self.document.get("kinematics_file"):
            found.append(f"{symbol} belongs to the arm with the kinematics of {self.document['kinematics_file']}.")
        return tuple(found)


@command("export", common=LOOK, short_help="Write a calibrated pose for ROS 2 or for Drake.")
def export(
    call: Call,
    result: Annotated[
        Path, typer.Argument(help="A result folder, or any file with a camera's pose (docs/hand_eye.md).")
    ],
    ros2: Annotated[
        Path | None, option("--ros2", "DIR", "Write a launch file, a static transform and a xacro file here.")
    ] = None,
    drake_directives: Annotated[
        Path | None,
        option("--drake-directives", "FILE", "Write Drake model directives here, such as station.dmd.yaml."),
    ] = None,
    parent: Annotated[
        str | None,
        option(
            "--parent",
            "FRAME",
            "Frame that the pose is stated in. With --drake-directives: a frame of your own model: panda::panda_link0.",
            show_default="base_link or tool0",
        ),
    ] = None,
    child: Annotated[str, option("--child", "FRAME", "Name of the scanner's frame.")] = CHILD,
    optical_pose: Annotated[
        str | None,
        option(
            "--optical-pose",
            '"X Y Z QX QY QZ QW"',
            "Pose (m) of the optical frame in --child, where the camera's driver publishes one.",
        ),
    ] = None,
    robot: Annotated[
        str | None, option("--robot", "NAME", "The robot, where the result does not name it: ur10e, franka_fr3 ...")
    ] = None,
    from_controller: Annotated[
        bool,
        switch(
            "--from-controller/--from-tf",
            "For a UR robot: the source of its poses. The controller's base is turned to base_link.",
        ),
    ] = True,
    pose: Annotated[
        str | None, option("--pose", "NAME", "The key of the pose, where the file of RESULT holds several.")
    ] = None,
    overwrite: Annotated[bool, switch("--overwrite", "Write over the files of an earlier export.")] = False,
) -> Outcome:
    """Write a calibrated pose as files for ROS 2, or as model directives for Drake.

    The scanner's frame is an optical frame: x right, y down, z forward. Its parent is the robot's base, or the tool
    flange where the scanner rides on it. docs/ros2_and_moveit.md explains the frames.
    """
    if (ros2 is None) == (drake_directives is None):
        raise typer.BadParameter("give one of --ros2 DIR and --drake-directives FILE")
    given = read_pose(result, robot, pose)
    X_child = RigidTransform()
    if optical_pose is not None:
        if child == CHILD:
            raise typer.BadParameter("--optical-pose needs --child, the frame that it is stated in")
        X_child = typed_pose(optical_pose)
    station = drake_directives is not None and parent is None
    X, parent, turned = placed(given, parent, X_child, of_ros=ros2 is not None, from_tf=not from_controller)
    check_frames(parent, child, scoped=ros2 is None)
    if ros2 is not None:
        texts = ros2_files(given, ros2, X, parent, child)
    else:
        assert drake_directives is not None
        texts = drake_files(given, drake_directives, X, parent, child, station=station)
    if not overwrite and (there := next((path for path in texts if path.exists()), None)) is not None:
        raise InputError(f"'{there}' exists. Give another place, or write over it with --overwrite.")
    for path, text in texts.items():
        write_atomic(path, text)
    first = str(next(iter(texts)))
    rows = {"parent": parent + turned, "child": child, "written": ", ".join(map(str, texts))}
    if ros2 is not None:
        rows["start it"] = f"ros2 launch {shlex.quote(first)}"
    elif first.endswith(".dmd.yaml"):
        rows["look at it"] = f"python -m pydrake.visualization.model_visualizer {shlex.quote(first)}"
    else:
        rows["note"] = "Drake's model_visualizer opens only names that end in .dmd.yaml."
    summary = {
        "state": "done",
        "parent": parent,
        "child": child,
        "xyz": [float(v) for v in X.translation()],
        "quaternion_xyzw": [float(v) for v in X.rotation().ToQuaternion().wxyz()[[1, 2, 3, 0]]],
        "files": [str(path) for path in texts],
        "notes": list(given.notes()),
    }
    return Outcome(summary, values={}, rows=rows | ({"corrected": " ".join(given.notes())} if given.notes() else {}))


def read_pose(result: Path, robot: str | None, pose: str | None) -> ExportedPose:
    """Read the calibrated pose of a result.

    Args:
        result: a result folder, or a file with a pose.
        robot: name of the robot; None: as the file names it.
        pose: key of the pose, where the file holds several.

    Raises:
        InputError: the file cannot be read, holds no pose or one that can be read in two ways, or an unknown robot.
    """
    inside = [result / name for name in (HAND_EYE_FILE, RESULT_FILE) if (result / name).is_file()]
    file = inside[0] if inside else result
    require_whole(file)
    given = read_stated_pose(file, pose)
    if len(given.readings) != 1:
        words = " or ".join(one.words for one in given.readings[:3])
        raise InputError(f"The pose in '{given.name}' can be read as {words}. Write it as a 4 x 4 matrix.")
    document = read_document(file) if file.suffix.lower() in (".yaml", ".yml", ".json") else {}
    document = document if isinstance(document, Mapping) else {}
    named = robot or str(document.get("robot") or "")
    frames = document.get("parameters")
    key = "robot_effector_frame" if given.mounting == "eye_in_hand" else "robot_base_frame"
    X = given.readings[0].X
    return ExportedPose(
        X=RigidTransform(RotationMatrix.ProjectToRotationMatrix(X[:3, :3]), X[:3, 3]),
        mounting=given.mounting,
        file=file,
        document=document,
        robot=get_robot(named).name if named and not named.lower().endswith(".urdf") else named,
        frame=str(frames.get(key) or "") if isinstance(frames, Mapping) else "",
    )


def typed_pose(text: str) -> RigidTransform:
    """Return the pose of seven numbers: x y z (m) and a quaternion x y z w, with or without commas and brackets.

    Raises:
        InputError: other than seven numbers, or a quaternion that is no unit one.
    """
    try:
        numbers = [float(word) for word in re.sub(r"[\[\],;]", " ", text).split()]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not np.isfinite(numbers).all():
        raise InputError(f"--optical-pose needs the seven numbers X Y Z QX QY QZ QW in quotes, not '{text}'.")
    q = np.array([numbers[6], *numbers[3:6]])
    length = float(np.linalg.norm(q))
    if abs(length - 1.0) > UNIT:
        raise InputError(f"The quaternion of --optical-pose has the length {length:.4g}, not 1; the order is x y z w.")
    return RigidTransform(Quaternion(q / length), numbers[:3])


def placed(
    given: ExportedPose, parent: str | None, X_child: RigidTransform, *, of_ros: bool, from_tf: bool
) -> tuple[RigidTransform, str, str]:
    """Find the pose of the child frame in its parent.

    Args:
        given: the calibrated pose.
        parent: name of the parent; None: the usual one of the robot's ROS description.
        X_child: pose of the optical frame in the child frame.
        of_ros: whether the parent is a frame of ROS and not of Drake.
        from_tf: whether the robot's poses were those of tf, so that B and F have the axes of the parent.

    Returns:
        The pose, the parent's name, and a phrase on its axes where they differ.

    Raises:
        InputError: no parent is given, and robot or mounting are not known.
    """
    X = given.X @ X_child.inverse()
    of_ur = given.robot in known_arms()
    frames = UR_FRAMES.get(given.mounting or "", ()) if of_ur else ()
    what = "flange" if given.mounting == "eye_in_hand" else "base"
    if parent is None and not of_ros:
        return X, f"{ARM}{what}", ""
    if parent is None and given.frame:
        return X, given.frame, ""
    if parent is None:
        usual = frames[0] if frames else OTHER_FRAMES.get(given.robot, {}).get(given.mounting or "")
        if usual is None and given.robot and given.mounting:
            raise InputError(
                f"The tf frames of the robot '{given.robot}' are not known: give its {what} with --parent."
            )
        if usual is None:
            lacks = "robot" if given.mounting else "mounting"
            raise InputError(
                f"'{given.file.name}' does not name the {lacks}: give the frame that its pose is in with --parent"
                + (", or the robot with --robot." if given.mounting else ".")
            )
        parent = usual
    name = next((one for one in frames if re.fullmatch(rf"(.*[_/])?{one}", parent)), "")
    if not of_ros or from_tf or name not in UR_TURNS:
        return X, parent, ""
    X = RigidTransform(UR_TURNS[name], np.zeros(3)) @ X
    return X, parent, f" (its axes are not those of the controller's {what})"


def check_frames(parent: str, child: str, *, scoped: bool) -> None:
    """Check names of frames; ``scoped``: of Drake's, which may name their model as in arm::base.

    Raises:
        InputError: a name that ROS or Drake does not take, or the same one twice.
    """
    for name, scope in ((parent, scoped), (child, False)):
        if not re.fullmatch(r"(\w+(::\w+)*)" if scope else r"\w+([/.-]\w+)*", name):
            raise InputError(f"'{name}' is no name of a frame: use letters, digits and _, without a slash in front.")
    if parent == child:
        raise InputError(f"Parent and child are the same frame '{parent}'. Give another with --parent or --child.")


def ros2_files(given: ExportedPose, folder: Path, X: RigidTransform, parent: str, child: str) -> dict[Path, str]:
    """Return the files for ROS 2 by their paths, the launch file first."""
    words = shlex.split(export_ros2(X, parent, child))
    arguments = words[words.index("static_transform_publisher") + 1 :]
    pairs = "".join(
        f'                "{key}", "{value}",\n' for key, value in zip(arguments[::2], arguments[1::2], strict=True)
    )
    kind = "EYE-IN-HAND" if given.mounting == "eye_in_hand" else "EYE-TO-HAND"
    launch = (
        f'"""{kind}: {parent} -> {child}, written by {software_version()} from {given.file.name}."""\n\n'
        f"{_comment(given)}"
        "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n\n\n"
        "def generate_launch_description():\n"
        f'    """Publish the pose of {child} in {parent}: metres, quaternion x y z w."""\n'
        "    return LaunchDescription([\n        Node(\n"
        '            package="tf2_ros",\n            executable="static_transform_publisher",\n'
        f'            name="{re.sub(r"[^0-9a-zA-Z_]", "_", child)}_publisher",\n            output="log",\n'
        f"            arguments=[\n{pairs}            ],\n        ),\n    ])\n"
    )
    return {
        folder / "scanner.launch.py": launch,
        folder / "static_transform.sh": _comment(given) + export_ros2(X, parent, child),
        folder / "scanner.urdf.xacro": export_urdf(X, parent, child, " ".join(given.notes()) or None),
    }


def drake_files(
    given: ExportedPose, path: Path, X: RigidTransform, parent: str, child: str, *, station: bool
) -> dict[Path, str]:
    """Return the Drake directives of the child frame, or of arm, flange and scanner with their models, by their paths.

    Raises:
        InputError: no name of a YAML file; the robot is not known, or its arm is not drawn.
    """
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"'{path}' is no name of a YAML file. Give one that ends in .dmd.yaml.")
    frame = export_drake_directive(X, parent, child)
    made = f"{_comment(given)}# {parent} -> {child}, written by {software_version()} from {given.file.name}.\n"
    if not station:
        return {path: made + frame}
    if given.robot not in known_arms():
        whose = f"The arm of '{given.robot}' cannot be drawn" if given.robot else f"'{given.file.name}' names no robot"
        raise InputError(
            f"{whose}: give --robot ({', '.join(known_arms())}), or with --parent a frame of your own model."
        )
    if given.mounting is None:
        raise InputError(
            f"'{given.file.name}' does not name the mounting: give a frame of your own model with --parent."
        )
    kinematics = given.document.get("kinematics_file")
    arm = load_arm(given.robot, given.file.parent / str(kinematics) if kinematics else None)
    standard = get_flange(str(given.document.get("flange") or get_robot(given.robot).flange))
    models = path.parent / f"{path.name.split('.')[0]}_models"
    home = "".join(
        f"      {joint}: [{math.radians(angle):.6f}]\n"
        for joint, angle in zip(arm.joint_names, Scenario().home_deg, strict=True)
    )

    def model(name: str) -> str:
        return f'- add_model:\n    name: {name}\n    file: "file://{models.absolute() / name}.urdf"\n'

    directives = (
        f"{made}# The models are in {models.name}: export again after you move them.\ndirectives:\n{model('arm')}"
        f"    default_joint_positions:\n{home}- add_weld:\n    parent: world\n    child: {ARM}base\n"
        f"{model('flange_face')}- add_weld:\n    parent: {ARM}flange\n    child: flange_face::flange_face\n"
        f"{frame.removeprefix('directives:').lstrip()}"
        f"{model('scanner')}- add_weld:\n    parent: {ARM}{child}\n    child: scanner::scanner\n"
    )
    return {
        path: directives,
        models / "arm.urdf": arm_urdf(arm),
        models / "flange_face.urdf": FLANGE_URDF,
        models / "flange_face.obj": flange_mesh(standard).to_obj(),
        models / "scanner.urdf": SCANNER_URDF,
    }


def _comment(given: ExportedPose) -> str:
    return "".join(f"# {note}\n" for note in given.notes())
