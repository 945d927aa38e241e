"""Grooved plates: closed meshes, an exact seam, and a ball that seats where the formula says."""

from __future__ import annotations

import math

import numpy as np
import open3d
import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddRigidHydroelasticProperties,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    HydroelasticContactRepresentation,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.errors import InputError
from weldcal.models.workpieces.plate import PlanarPath, Workpiece, make_workpiece, seeded_groove_error

SHAPES = ("straight", "s", "l")
GROOVE_ERROR = seeded_groove_error(np.random.default_rng(4))


def _variants() -> list[Workpiece]:
    made = [make_workpiece(shape) for shape in SHAPES]
    made += [make_workpiece(shape, X_PG=GROOVE_ERROR) for shape in SHAPES]
    return made + [make_workpiece(shape, end_cut_m=0.25, X_PG=GROOVE_ERROR) for shape in SHAPES]


VARIANTS = _variants()
NAMES = [f"{w.shape}-{k // 3}" for k, w in enumerate(VARIANTS)]


def _distance(workpiece: Workpiece, points: np.ndarray) -> np.ndarray:
    scene = open3d.t.geometry.RaycastingScene()
    vertices, triangles = workpiece.mesh.vertices.astype(np.float32), workpiece.mesh.triangles.astype(np.uint32)
    scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(triangles))
    return np.asarray(scene.compute_distance(open3d.core.Tensor(points.astype(np.float32))).numpy())


@pytest.mark.parametrize("w", VARIANTS, ids=NAMES)
def test_plate_and_groove_are_closed_solids(w: Workpiece) -> None:
    assert w.mesh.watertight()
    assert w.groove_mesh.watertight()
    assert w.groove_mesh.volume > 0.0
    assert len(w.groove_mesh.triangles) <= 4000


@pytest.mark.parametrize("w", VARIANTS, ids=NAMES)
def test_the_plate_lacks_exactly_the_swept_groove(w: Workpiece) -> None:
    width, height = np.ptp(w.outline_P, axis=0)
    groove = w.half_width_m * w.depth_m * w.length_m
    # Pappus: the V's area times the length of the path of its centroid, which lies on the seam. Chords of 1 mm on a
    # 20 mm corner and oblique ends change this by well under a cubic millimetre each.
    assert w.mesh.volume == pytest.approx(width * height * w.size_m[2] - groove, abs=1e-9)


@pytest.mark.parametrize("w", VARIANTS, ids=NAMES)
def test_the_seam_is_evenly_spaced_and_runs_from_edge_to_edge(w: Workpiece) -> None:
    step = np.linalg.norm(np.diff(w.seam_P, axis=0), axis=1)
    # Chords of 0.5 mm on a 20 mm radius are 13 nm short.
    np.testing.assert_allclose(step, np.diff(w.arc_length_m), atol=2e-8)
    assert step.mean() == pytest.approx(5e-4, rel=0.01)
    np.testing.assert_allclose(w.seam_P[:, 2], -w.depth_m)
    low, high = w.outline_P.min(axis=0), w.outline_P.max(axis=0)
    for end in (w.seam_P[0, :2], w.seam_P[-1, :2]):
        assert np.min(np.abs(np.concatenate([end - low, end - high]))) < 1e-9
    inner = w.seam_P[1:-1, :2]
    assert ((inner > low) & (inner < high)).all()
    # Central differences of an arc of radius R are its tangents up to (step / R)^2 / 6; curvature jumps cost step / 4R.
    slope = w.seam_P[2:] - w.seam_P[:-2]
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    assert np.abs(slope - w.tangents_P[1:-1]).max() < 0.008


def test_drawn_seams_have_the_lengths_and_turns_they_are_known_by() -> None:
    for w in VARIANTS[:3]:
        assert w.length_m == pytest.approx(0.3, abs=1e-9)
    turns = [np.unwrap(np.arctan2(w.tangents_P[:, 1], w.tangents_P[:, 0])) for w in VARIANTS[:3]]
    assert np.ptp(turns[0]) == pytest.approx(0.0, abs=1e-9)
    # The samples miss the apex of the S by up to half a step: 0.25 mm of a 60 mm radius.
    assert turns[1].max() == pytest.approx(math.radians(60), abs=0.005)
    assert turns[1][-1] == pytest.approx(0.0, abs=1e-9)
    assert turns[2][-1] == pytest.approx(math.radians(90), abs=1e-9)


@pytest.mark.parametrize("w", VARIANTS, ids=NAMES)
def test_a_ball_at_the_seated_height_touches_both_walls(w: Workpiece) -> None:
    radius = 0.0025
    line = (w.seam_P + w.tip_height(radius) * w.up_P)[20:-20:3]
    assert line[0, 2] == pytest.approx(-w.depth_m + radius / math.sin(math.radians(22.5)), abs=1e-12)
    # Walls are chords of 1 mm: at the tightest wall (20 mm less half a groove) they lie 8 um off the true surface.
    np.testing.assert_allclose(_distance(w, line), radius, atol=1e-5)


def test_a_ball_wider_than_the_groove_is_refused() -> None:
    with pytest.raises(InputError, match="too large"):
        VARIANTS[0].tip_height(0.0036)


def test_the_groove_moves_and_the_outline_stays() -> None:
    drawn, real = make_workpiece("s"), make_workpiece("s", X_PG=GROOVE_ERROR)
    np.testing.assert_array_equal(drawn.outline_P, real.outline_P)
    np.testing.assert_allclose(drawn.mesh.bounds, real.mesh.bounds, atol=1e-12)
    moved = drawn.seam_P @ GROOVE_ERROR.rotation().matrix().T + GROOVE_ERROR.translation()
    inside = np.abs(moved[:, 0]) < 0.5 * drawn.size_m[0] - 0.001
    gap = np.linalg.norm(real.seam_P[None, :, :] - moved[inside][::10, None, :], axis=2).min(axis=1)
    # Nearest of points 0.5 mm apart: at most half a step away along the seam.
    assert gap.max() < 2.6e-4


def test_the_seeded_groove_error_has_the_asked_size() -> None:
    errors = [seeded_groove_error(np.random.default_rng(s), 0.002, 0.01) for s in range(40)]
    for X in errors:
        assert np.linalg.norm(X.translation()) == pytest.approx(0.002)
        assert abs(RollPitchYaw(X.rotation()).yaw_angle()) == pytest.approx(0.01)
        assert X.translation()[2] == 0.0
    assert {RollPitchYaw(X.rotation()).yaw_angle() > 0 for X in errors} == {True, False}
    directions = np.array([X.translation()[:2] for X in errors])
    assert (directions.max(axis=0) > 0.001).all()
    assert (directions.min(axis=0) < -0.001).all()
    assert seeded_groove_error(np.random.default_rng(3)).IsExactlyEqualTo(seeded_groove_error(np.random.default_rng(3)))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_part_cut_short_ends_where_asked_and_keeps_its_frame(shape: str) -> None:
    whole, short = make_workpiece(shape), make_workpiece(shape, end_cut_m=0.22)
    assert short.length_m == pytest.approx(0.22, abs=1e-9)
    n = min(len(whole.seam_P), len(short.seam_P))
    np.testing.assert_allclose(short.seam_P[:n], whole.seam_P[:n], atol=1e-9)
    assert short.mesh.bounds[0] == pytest.approx(whole.mesh.bounds[0])


@pytest.mark.parametrize(
    ("kwargs", "advice"),
    [
        ({"shape": "circle"}, "straight, s or l"),
        ({"shape": "l", "radius_m": 0.003}, "use more than"),
        ({"shape": "s", "length_m": 0.1}, "does not fit"),
        ({"shape": "s", "depth_m": 0.03}, "does not fit"),
        ({"shape": "l", "end_cut_m": 0.1}, "end_cut_m"),
        ({"shape": "straight", "X_PG": RigidTransform(np.array([0.0, 0.0, 0.001]))}, "within the top face"),
        ({"shape": "straight", "X_PG": RigidTransform(np.array([0.3, 0.0, 0.0]))}, "misses"),
    ],
)
def test_impossible_plates_are_refused_with_advice(kwargs: dict[str, object], advice: str) -> None:
    with pytest.raises(InputError, match=advice):
        make_workpiece(**kwargs)  # type: ignore[arg-type]


def test_paths_run_on_straight_beyond_their_ends() -> None:
    path = PlanarPath((0.0, 0.0, 0.0), ((0.1, 0.0), (0.1 * math.pi / 2, 10.0)))
    points, headings = path.at([-0.05, 0.0, 0.1, 0.1 + 0.05 * math.pi, 0.1 + 0.05 * math.pi + 0.03])
    np.testing.assert_allclose(points, [(-0.05, 0), (0, 0), (0.1, 0), (0.2, 0.1), (0.2, 0.13)], atol=1e-12)
    np.testing.assert_allclose(headings, [0, 0, 0, math.pi / 2, math.pi / 2], atol=1e-12)


def test_drake_feels_both_walls_of_the_groove() -> None:
    w = make_workpiece("s")
    radius = 0.0025
    sink = 1e-4
    k = len(w.seam_P) // 2
    center = (w.seam_P + w.tip_height(radius) * w.up_P)[k] - [0.0, 0.0, sink]
    graph = SceneGraph()
    source = graph.RegisterSource("test")
    rigid, soft = ProximityProperties(), ProximityProperties()
    AddRigidHydroelasticProperties(0.001, rigid)
    AddCompliantHydroelasticProperties(0.5 * radius, 1e7, soft)
    groove = GeometryInstance(RigidTransform(), w.groove_mesh.to_drake("groove"), "groove")
    groove.set_proximity_properties(rigid)
    graph.RegisterAnchoredGeometry(source, groove)
    frame = graph.RegisterFrame(source, GeometryFrame("tip"))
    tip = GeometryInstance(RigidTransform(), Sphere(radius), "tip")
    tip.set_proximity_properties(soft)
    graph.RegisterGeometry(source, frame, tip)
    poses = FramePoseVector()
    poses.set_value(frame, RigidTransform(center))
    context = graph.CreateDefaultContext()
    graph.get_source_pose_port(source).FixValue(context, poses)
    query = graph.get_query_output_port().Eval(context)
    surfaces = query.ComputeContactSurfaces(HydroelasticContactRepresentation.kPolygon)
    assert len(surfaces) == 1
    p = np.array([surfaces[0].centroid(f) for f in range(surfaces[0].num_faces())])
    left = np.cross([0.0, 0.0, 1.0], w.tangents_P[k])
    side = (p - w.seam_P[k]) @ left
    # The ball meets each wall a distance r cos(half angle) beside the root; it sinks in by sink * sin(half angle).
    expected = radius * math.cos(w.half_angle_rad)
    patch = math.sqrt(2.0 * radius * sink)
    assert side[side > 0].mean() == pytest.approx(expected, abs=patch)
    assert side[side < 0].mean() == pytest.approx(-expected, abs=patch)
    assert np.abs(side).min() > 0.5 * expected
