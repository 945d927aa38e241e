"""Provide a separate scene graph for a camera, and a stand that is displaced.

Its poses are updated only when a picture is taken.
"""

from dataclasses import dataclass
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    FrameId,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    MakeRenderEngineVtk,
    RenderEngineVtkParams,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, DiagramBuilder

from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import Message


class PicturePoses(LeafSystem):
    """Computes the poses of the bodies in a camera's scene.

    .. pydrake_system::

        name: PicturePoses
        input_ports:
        - body_poses
        output_ports:
        - frame_poses

    The poses are calculated only when a picture is taken. A renderer on the contact model's scene graph would be
    updated at every plant step (500 Hz), which costs as much as the contact computation.
    """

    def __init__(self, plant: MultibodyPlant, frames: dict[BodyIndex, FrameId]) -> None:
        super().__init__()
        self._frames = frames
        self._body_poses = self.DeclareAbstractInputPort("body_poses", plant.get_body_poses_output_port().Allocate())
        self.DeclareAbstractOutputPort(
            "frame_poses", lambda: AbstractValue.Make(FramePoseVector()), self._calculate, {self._body_poses.ticket()}
        )

    def _calculate(self, context: Context, output: Any) -> None:
        body_poses = self._body_poses.Eval(context)
        found = FramePoseVector()
        for body, frame in self._frames.items():
            found.set_value(frame, body_poses[body])
        output.set_value(found)


@dataclass(frozen=True)
class PictureScene(Message):
    """A scene graph with one renderer, the frames of its moving bodies, and the system that computes their poses."""

    scene_graph: SceneGraph
    renderer: str
    frames: dict[BodyIndex, FrameId]
    poses: PicturePoses


def add_picture_scene(
    builder: DiagramBuilder, plant: MultibodyPlant, drawn: SceneGraph, renderer: str, mount: str | None = None
) -> PictureScene:
    """Add a scene with the visual geometry that the bodies of `plant` have in the scene graph `drawn`.

    Args:
        plant: finalised.
        renderer: name of the VTK renderer created for the scene.
        mount: name of the body that carries the camera; None: the camera is fixed.
    """
    scene = builder.AddNamedSystem(f"{renderer}_scene", SceneGraph())
    scene.AddRenderer(renderer, MakeRenderEngineVtk(RenderEngineVtkParams()))
    source = scene.RegisterSource("world")
    inspector = drawn.model_inspector()
    world = plant.world_body().index()
    frames: dict[BodyIndex, FrameId] = {world: scene.world_frame_id()}

    def frame_of(body: BodyIndex) -> FrameId:
        if body not in frames:
            frames[body] = scene.RegisterFrame(source, GeometryFrame(str(plant.get_body(body).scoped_name())))
        return frames[body]

    if mount is not None:
        frame_of(plant.GetBodyByName(mount).index())
    for geometry in inspector.GetAllGeometryIds(Role.kPerception):
        name = inspector.GetName(geometry)
        body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).index()
        copy = GeometryInstance(inspector.GetPoseInFrame(geometry), inspector.GetShape(geometry), name)
        copy.set_perception_properties(inspector.GetPerceptionProperties(geometry))
        if body == world:
            scene.RegisterAnchoredGeometry(source, copy)
        else:
            scene.RegisterGeometry(source, frame_of(body), copy)
    del frames[world]
    poses = builder.AddNamedSystem(f"{renderer}_poses", PicturePoses(plant, frames))
    builder.Connect(plant.get_body_poses_output_port(), poses.GetInputPort("body_poses"))
    builder.Connect(poses.GetOutputPort("frame_poses"), scene.get_source_pose_port(source))
    return PictureScene(scene, renderer, frames, poses)


class DisplacedStand(LeafSystem):
    """Computes the pose of a camera's stand, which jumps once.

    .. pydrake_system::

        name: DisplacedStand
        output_ports:
        - frame_poses

    The stand's frame is the base until ``time_s`` and displaced by ``displacement`` in the base from then on.
    """

    def __init__(self, frame: FrameId, time_s: float, displacement: RigidTransform) -> None:
        super().__init__()
        self._frame, self._time_s, self._displacement = frame, time_s, displacement
        self.DeclareAbstractOutputPort(
            "frame_poses", lambda: AbstractValue.Make(FramePoseVector()), self._calculate, {self.time_ticket()}
        )

    def _calculate(self, context: Context, output: Any) -> None:
        found = FramePoseVector()
        found.set_value(self._frame, self._displacement if context.get_time() >= self._time_s else RigidTransform())
        output.set_value(found)


def add_stand(builder: DiagramBuilder, scene: PictureScene, time_s: float, displacement: RigidTransform) -> FrameId:
    """Add a stand at the base's frame that jumps by ``displacement`` at ``time_s``.

    Returns its frame in the camera's scene.
    """
    graph = scene.scene_graph
    source = graph.RegisterSource("stand")
    frame = graph.RegisterFrame(source, GeometryFrame("stand"))
    stand = builder.AddNamedSystem("knocked_stand", DisplacedStand(frame, time_s, displacement))
    builder.Connect(stand.GetOutputPort("frame_poses"), graph.get_source_pose_port(source))
    return frame
