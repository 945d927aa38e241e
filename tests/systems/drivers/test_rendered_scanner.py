"""The simulated scanner: pixel centres where OpenCV has them, one cloud per trigger, and the same noise for the same
seed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    GeometryInstance,
    MakePhongIllustrationProperties,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderEngineVtkParams,
    SceneGraph,
    SourceId,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import ImageDepth32F

from tests.systems.cells import Q_HOME, the_arm
from tests.worlds.scaled_arms import perfect
from weldcal.models.scanners import apply_noise, depth_to_points, get_scanner
from weldcal.models.tool import WeldingTool
from weldcal.systems.drivers.simulated.picture_scene import PictureScene
from weldcal.systems.drivers.simulated.rendered_scanner import (
    ApplyDriverConfig,
    DepthSensor,
    RenderedScanner,
    darkness,
    random_pose_error,
)
from weldcal.systems.drivers.simulated.world import SCANNER_RENDERER, SimulatedWorld
from weldcal.systems.drivers.station_build import StationBuild
from weldcal.systems.messages import Scan
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.station import make_station

DISTANCE_M = 0.7
HALF_M = np.array([0.10, 0.07])  # half the sides of the plate that is looked at
X_BC = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, DISTANCE_M])
X_BPlate = RigidTransform(
    RollPitchYaw(0.35, 0.30, 0.20), np.zeros(3)
)  # tilted by 26 degrees, its edges askew in the image


def a_scene(builder: DiagramBuilder) -> SceneGraph:
    """One tilted plate in mid-air: its top face lies in its own plane z = 0."""
    scene_graph = builder.AddSystem(SceneGraph())
    scene_graph.AddRenderer(SCANNER_RENDERER, MakeRenderEngineVtk(RenderEngineVtkParams()))
    source: SourceId = scene_graph.RegisterSource("plate")
    below = RigidTransform([0.0, 0.0, -0.005])
    plate = GeometryInstance(X_BPlate @ below, Box(2 * HALF_M[0], 2 * HALF_M[1], 0.010), "plate")
    plate.set_illustration_properties(MakePhongIllustrationProperties([0.5, 0.5, 0.5, 1.0]))
    plate.set_perception_properties(PerceptionProperties())
    scene_graph.RegisterAnchoredGeometry(source, plate)
    return scene_graph


def scan_of_the_plate(width: int = 824, height: int = 616) -> Scan:
    """What the driver's own chain of camera and scanner returns."""
    builder = DiagramBuilder()
    config = RenderedScanner(
        preset="ideal",
        width=width,
        height=height,
        xyz_m=[0.0, 0.0, DISTANCE_M],
        rpy_deg=[180.0, 0.0, 0.0],
        mounting_translation_mm=0.0,
        mounting_rotation_deg=0.0,
        exposure_s=0.0,
    )
    scene = a_scene(builder)
    still: Any = None  # nobody moves in it
    world = SimulatedWorld(
        plant=still,
        scene_graph=scene,
        arm=still,
        tool=None,
        scanner_view=PictureScene(scene, SCANNER_RENDERER, {}, still),
        second=None,
    )
    build = StationBuild(
        builder=builder, arm=the_arm(), tool=WeldingTool(), q_start=Q_HOME, rng=np.random.default_rng(0), parts=(world,)
    )
    assert ApplyDriverConfig(config, build).IsNearlyEqualTo(X_BC, 1e-12)
    builder.ExportInput(build.inputs["scanner.trigger"], "trigger")
    builder.ExportOutput(build.outputs["scanner.scan"], "scan")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    diagram.GetInputPort("trigger").FixValue(simulator.get_mutable_context(), [1.0])
    simulator.AdvanceTo(0.05)
    scan: Scan = diagram.GetOutputPort("scan").Eval(simulator.get_context())
    return scan


@pytest.fixture(scope="module")
def plate_scan() -> Scan:
    return scan_of_the_plate()


def in_plate(points_C: np.ndarray) -> np.ndarray:
    """The organised cloud in the plate's own frame, (H, W, 3)."""
    X_PlateC = X_BPlate.inverse() @ X_BC
    p: np.ndarray = points_C.astype(float) @ X_PlateC.rotation().matrix().T + X_PlateC.translation()
    return p


def the_face(scan: Scan) -> np.ndarray:
    """Which pixels show the plate's top face, and not its sides: (H, W)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(in_plate(scan.points_C)[..., 2]) < 1e-4)


def height_and_middle(p_Plate: np.ndarray, face: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean height of the face over its plane, and the middle of what is seen of it, from its four edges: (2,) m.

    The outermost pixels lie up to a pixel inside an edge; the edges run askew, so over many rows and columns that
    averages to half a pixel on either side, which the middle is free of.
    """
    middle = []
    for axis, lines, seen in ((0, p_Plate, face), (1, p_Plate.transpose(1, 0, 2), face.T)):
        ends = []
        for line, here in zip(lines, seen, strict=True):
            found = line[here]
            # Only lines that run from edge to opposite edge: at both ends they are far from the other two edges.
            if len(found) > 20 and np.abs(found[[0, -1], 1 - axis]).max() < HALF_M[1 - axis] - 0.02:
                ends.append(found[[0, -1], axis])
        assert len(ends) > 20
        middle.append(np.mean(ends))
    return float(p_Plate[face][:, 2].mean()), np.array(middle)


def test_a_tilted_plate_is_found_where_it_lies(plate_scan: Scan) -> None:
    p, face = in_plate(plate_scan.points_C), the_face(plate_scan)
    within = (np.abs(p[..., :2]) < HALF_M - 0.002).all(axis=2)
    assert within.sum() > 20000
    # 0.1 mm is the demand; what is left is the depth buffer's own resolution.
    assert face[within].all()
    height, middle = height_and_middle(p, face)
    assert abs(height) < 2e-5
    assert np.abs(middle).max() < 1e-4


def test_half_a_pixel_left_out_would_move_it_by_half_a_millimetre(plate_scan: Scan) -> None:
    preset = get_scanner("ideal", width=824, height=616)
    # Drake's own numbers for the principal point, half a pixel more than OpenCV's, taken as if they were OpenCV's.
    wrong = depth_to_points(plate_scan.points_C[..., 2], preset.fx, preset.fy, preset.cx + 0.5, preset.cy + 0.5)
    shift_C = -0.5 * DISTANCE_M * np.array([1.0 / preset.fx, 1.0 / preset.fy, 0.0])
    assert np.linalg.norm(shift_C) == pytest.approx(0.545e-3, abs=0.005e-3)
    expected = (X_BPlate.inverse() @ X_BC).rotation() @ shift_C
    height, middle = height_and_middle(in_plate(wrong), the_face(plate_scan))
    assert [*middle, height] == pytest.approx(expected, abs=1e-4)
    assert np.linalg.norm([*middle, height]) > 0.45e-3


def test_a_coarser_image_sees_the_same_plate(plate_scan: Scan) -> None:
    coarse = scan_of_the_plate(412, 308)
    height, middle = height_and_middle(in_plate(coarse.points_C), the_face(coarse))
    assert abs(height) < 2e-5
    assert np.abs(middle).max() < 2e-4  # twice the pixel, half the lines


class Bench:
    """A scanner alone, looking at a wall that the test moves."""

    def __init__(self, preset: str = "phoxi_m", seed: int = 3, exposure_s: float = 0.1) -> None:
        self.scanner = DepthSensor(get_scanner(preset, width=64, height=48), seed, exposure_s)
        self.simulator = Simulator(self.scanner)
        self.context = self.simulator.get_mutable_context()
        self.wall(0.65)
        self.trigger(0)

    def wall(self, depth_m: float) -> None:
        image = ImageDepth32F(64, 48)
        image.mutable_data[:] = depth_m
        self.scanner.GetInputPort("depth_image").FixValue(self.context, AbstractValue.Make(image))

    def trigger(self, sequence: int) -> None:
        self.scanner.GetInputPort("trigger").FixValue(self.context, [float(sequence)])

    def scan_at(self, time: float) -> Scan:
        self.simulator.AdvanceTo(time)
        scan: Scan = self.scanner.GetOutputPort("scan").Eval(self.context)
        return scan


def test_without_a_trigger_there_is_no_scan() -> None:
    scan = Bench().scan_at(0.5)
    assert scan.sequence == 0
    assert scan.points_C.size == 0


def test_one_trigger_makes_one_scan_after_the_exposure_of_what_was_there_before_it() -> None:
    bench = Bench("ideal")
    bench.trigger(1)
    assert bench.scan_at(0.05).sequence == 0
    bench.wall(0.8)  # moved during the exposure: too late to be seen
    scan = bench.scan_at(0.15)
    assert scan.sequence == 1
    assert scan.capture_time == 0.0
    assert scan.points_C.shape == (48, 64, 3)
    assert scan.points_C[..., 2] == pytest.approx(0.65)
    assert bench.scan_at(0.6) is scan  # no second one by itself
    bench.trigger(2)
    assert bench.scan_at(0.8).points_C[..., 2] == pytest.approx(0.8)


def test_what_is_out_of_range_is_not_a_number() -> None:
    bench = Bench("phoxi_m")
    bench.wall(np.inf)
    bench.trigger(1)
    assert np.isnan(bench.scan_at(0.2).points_C).all()


def test_the_noise_belongs_to_the_seed_and_the_scan() -> None:
    clouds = {}
    for name, seed, sequence in (("one", 3, 1), ("again", 3, 1), ("next scan", 3, 2), ("other seed", 4, 1)):
        bench = Bench(seed=seed)
        bench.trigger(sequence)
        clouds[name] = bench.scan_at(0.2).points_C
    assert np.array_equal(clouds["one"], clouds["again"], equal_nan=True)
    assert not np.array_equal(clouds["one"], clouds["next scan"], equal_nan=True)
    assert not np.array_equal(clouds["one"], clouds["other seed"], equal_nan=True)


def test_a_random_pose_error_has_exactly_the_size_that_was_asked_for() -> None:
    rng = np.random.default_rng(0)
    errors = [random_pose_error(rng, 0.015, 0.026) for _ in range(50)]
    assert [np.linalg.norm(X.translation()) for X in errors] == pytest.approx([0.015] * 50)
    assert [X.rotation().ToAngleAxis().angle() for X in errors] == pytest.approx([0.026] * 50)
    directions = np.array([X.translation() for X in errors]) / 0.015
    assert np.linalg.norm(directions.mean(axis=0)) < 0.5  # every way, not one: 3 sigma of 50 unit vectors is 0.42
    assert random_pose_error(rng, 0.0, 0.0).IsNearlyEqualTo(RigidTransform(), 1e-15)


def test_the_field_of_view_is_the_scenarios() -> None:
    narrow = RenderedScanner(field_of_view_deg=20.0).scanner()
    own = RenderedScanner().scanner()
    assert 2.0 * np.degrees(np.arctan(0.5 * narrow.width / narrow.fx)) == pytest.approx(20.0)
    assert narrow.fy / narrow.fx == pytest.approx(own.fy / own.fx)
    assert (narrow.cx, narrow.cy) == (own.cx, own.cy)


def test_black_is_dark_and_steel_is_not() -> None:
    picture = np.stack([np.full((2, 2, 3), level, dtype=np.float32) for level in (0.0, 40.0, 160.0)])
    assert darkness(picture).max(axis=(1, 2)) == pytest.approx([1.0, 0.5, 0.0], abs=1e-6)


def test_a_dark_surface_is_measured_less_often_than_a_bright_one() -> None:
    """The tool's dark plate against the steel ring that stands on it, as the scanner of the demo sees them."""
    scenario = perfect(load_scenario("s_groove", "job: {weld: false}"))
    station = make_station(scenario, seed=0)
    context = station.diagram.CreateDefaultContext()
    sensor = station.diagram.GetSubsystemByName("scanner_depth")
    color = sensor.color_image_output_port().Eval(sensor.GetMyContextFromRoot(context)).data[:, :, :3]
    dark = darkness(np.asarray(color, dtype=np.float32))
    depth = np.array(sensor.depth_image_32F_output_port().Eval(sensor.GetMyContextFromRoot(context)).data[:, :, 0])
    assert (dark > 0.5).any(), "something in the scene is dark"
    preset = RenderedScanner().scanner()
    seen = apply_noise(np.where(np.isfinite(depth), depth, 0.0), preset, np.random.default_rng(0), dark) > 0
    ideal = np.isfinite(depth) & (depth > preset.near_m) & (depth < preset.far_m)
    assert seen[ideal & (dark > 0.9)].mean() < seen[ideal & (dark < 0.1)].mean() - 0.01
