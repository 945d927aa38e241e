"""A picture of a mounting as it stands in simulation, with its frames drawn into it."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from weldcal.calibration.planning.mounting_scene import BASE, FLANGE
from weldcal.models.arrays import Array
from weldcal.tools.outcomes.mounting import MountingReport

WIDTH, HEIGHT, FOCAL = 1000, 640, 900.0
AXES_M = 0.10
COLOURS = ("#d33d2f", "#2c9a45", "#2b5fc4")
_PLATE = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}


def station_picture(report: MountingReport) -> bytes | None:
    """PNG of the station at the last calibration pose: arms, scanner, circle, and the frames by their letters.

    Seen from the side on which the frames lie farthest apart. It shows what truly is: None where nothing is simulated.
    """
    run, cell = report.run, report.run.cell
    world = cell.station.world
    if world is None:
        return None
    pose = report.status.seen[-1].pose if report.status.seen else report.job.plan[0]
    frames = true_frames(report, pose.q, pose.q_2)
    root = run.root.Clone()
    plant_context = world.plant.GetMyMutableContextFromRoot(root)
    world.plant.SetPositions(plant_context, world.arm, pose.q)
    if world.second is not None and pose.q_2 is not None:
        world.plant.SetPositions(plant_context, world.second, pose.q_2)
    light = LightParameter(type="directional", direction=(0.3, -0.2, 1.0), frame="camera", intensity=1.1)
    params = RenderEngineVtkParams(default_clear_color=np.array([0.94, 0.95, 0.97]), lights=[light])
    scene_graph, name = world.scene_graph, "picture"
    scene_graph.AddRenderer(scene_graph.GetMyMutableContextFromRoot(root), name, MakeRenderEngineVtk(params))
    X_WV = _best_view(frames)
    core = RenderCameraCore(
        name,
        CameraInfo(WIDTH, HEIGHT, FOCAL, FOCAL, 0.5 * WIDTH, 0.5 * HEIGHT),
        ClippingRange(0.05, 20.0),
        RigidTransform(),
    )
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
    image = query.RenderColorImage(ColorRenderCamera(core, False), scene_graph.world_frame_id(), X_WV)
    return _annotated(np.array(image.data[:, :, :3]), frames, X_WV)


def true_frames(report: MountingReport, q: Array, q_2: Array | None) -> dict[str, RigidTransform]:
    """Letter -> pose in the base B of every frame in the mounting's sketch, as it truly is."""
    scene = report.job.scene.believing(report.job.truth)
    links = scene.frames(q)
    found = {"B": RigidTransform(), "F": links[FLANGE], "C": links[scene.link] @ scene.X_LC}
    if scene.link not in (BASE, FLANGE):
        found["L"] = links[scene.link]
    if scene.two and scene.X_BD is not None and q_2 is not None:
        found |= {"D": scene.X_BD, "E": scene.frames_2(q_2)[FLANGE]}
    found["M"] = scene.circle(links, q_2)
    return found


def _best_view(frames: dict[str, RigidTransform]) -> RigidTransform:
    """From a little above, far enough for all frames, where the nearest two of them are farthest apart in the picture."""
    points = np.array([X.translation() for X in frames.values()])
    distinct = points[[all(np.linalg.norm(p - o) > 0.03 for o in points[:i]) for i, p in enumerate(points)]]
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0)) + np.array([0.0, 0.0, 0.05])
    distance = 0.9 + 1.9 * float(np.linalg.norm(points - middle, axis=1).max())
    best, widest = RigidTransform(), -1.0
    for azimuth in np.radians(np.arange(0.0, 360.0, 15.0)):
        away = np.array([np.cos(azimuth) * 0.88, np.sin(azimuth) * 0.88, 0.47])
        z = -away / np.linalg.norm(away)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        X_WV = RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), middle - distance * z)
        seen = _project(points, X_WV)
        # centre the picture on the frames, and leave room for an arm's elbow above them
        shift = 0.5 * (seen.min(axis=0) + seen.max(axis=0)) - [0.5 * WIDTH, 0.5 * HEIGHT + 0.06 * HEIGHT]
        X_WV = X_WV @ RigidTransform([*(shift * distance / FOCAL), 0.0])
        uv = _project(distinct, X_WV)
        gaps = np.linalg.norm(uv[:, None] - uv[None], axis=2) + 1e9 * np.eye(len(uv))
        if float(gaps.min()) > widest:
            best, widest = X_WV, float(gaps.min())
    return best


def _project(points: Array, X_WV: RigidTransform) -> Array:
    p = np.asarray(X_WV.inverse() @ np.atleast_2d(points).T).reshape(3, -1).T
    return np.asarray(FOCAL * p[:, :2] / p[:, 2:] + [0.5 * WIDTH, 0.5 * HEIGHT])


def _annotated(image: NDArray[np.uint8], frames: dict[str, RigidTransform], X_WV: RigidTransform) -> bytes:
    figure = Figure(figsize=(WIDTH / 100.0, HEIGHT / 100.0), dpi=120)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image)
    axes.set_axis_off()
    sight = _project(np.array([frames["C"].translation(), frames["M"].translation()]), X_WV)
    axes.plot(*sight.T, linestyle="--", color="#333", linewidth=1.2)
    placed: list[Array] = []
    for letter, X in frames.items():
        _draw_frame(axes, letter, X, X_WV, placed)
    axes.set_xlim(0, WIDTH)
    axes.set_ylim(HEIGHT, 0)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def _draw_frame(axes: Axes, letter: str, X: RigidTransform, X_WV: RigidTransform, placed: list[Array]) -> None:
    tips = X.translation() + AXES_M * X.rotation().matrix().T
    uv = _project(np.vstack([X.translation(), tips]), X_WV)
    for tip, colour in zip(uv[1:], COLOURS, strict=True):
        axes.plot(*np.array([uv[0], tip]).T, color=colour, linewidth=2.2, solid_capstyle="round")
    at = uv[0] + np.array([14.0, -16.0])
    while any(np.linalg.norm(at - other) < 24.0 for other in placed):
        at = at + np.array([26.0, 0.0])
    placed.append(at)
    axes.annotate(letter, at, fontsize=12, fontweight="bold", ha="center", va="center", bbox=_PLATE)
