"""A scenario's part from a file: paths, refusals before any work, and the same keys as for a plate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.worlds.parts.cells import PartTrial, write_cell
from tests.worlds.parts.step_parts import PARTS, assembly, box, less, prism, write_step
from weldcal.models.errors import InputError
from weldcal.models.mesh import extrude
from weldcal.models.workpieces.part import Part, numbered, seam_count
from weldcal.models.workpieces.reading import read_shape
from weldcal.systems.jobs.weld.settings import job_plan, seated_tip, servo_config
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.parts import part_of
from weldcal.systems.scenario.schema import ErrorConfig, Scenario, SeamConfig, WorkpieceConfig
from weldcal.systems.station import make_station


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The path of a scenario that welds a fillet, beside its STEP file and its seam."""
    return write_cell(PARTS["straight_web"](), tmp_path_factory.mktemp("cell"), PartTrial(located_by="drawing"))


def test_its_paths_are_relative_to_the_scenarios_file(
    cell: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    spec = load_scenario(str(cell)).workpiece
    assert spec is not None
    part = part_of(spec)
    assert 1e3 * part.length_m == pytest.approx(200.0, abs=1e-6)
    assert part.seam.joint == "fillet"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("file: straight_web.step", "file: other.step", "no file '.*other.step'"),
        ("units: mm", "units: cm", "units must be mm, m, inch"),
        ("joint: fillet", "joint: dovetail", "cannot be 'dovetail'"),
        ("  joint: fillet\n", "", "joint is missing"),
        ("seams: [{polyline: straight_web.csv}]", "seams: []", "seams is missing: .*weldcal part straight_web.step"),
        ("polyline: straight_web.csv", "polyline: none.csv", "no file '.*none.csv'"),
        ("polyline: straight_web.csv", "polyline: straight_web.csv, edges: [1]", "either polyline"),
        ("polyline: straight_web.csv", "edges: [1], start_mm: -1", "0 or more"),
        ("  joint: fillet\n", "  joint: fillet\n  bend_radius_mm: 300\n", "bend_radius_mm is for the plates"),
        ("  file: straight_web.step\n", "", "units belongs to a part from a file"),
    ],
)
def test_a_mistake_is_one_sentence_before_any_work(cell: Path, old: str, new: str, says: str) -> None:
    text = cell.read_text()
    assert old in text
    wrong = cell.with_name("wrong.yaml")
    wrong.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=says):
        load_scenario(str(wrong))


def test_the_station_has_the_part_as_drawn_and_the_true_one_apart(cell: Path) -> None:
    scenario = load_scenario(str(cell))
    station = make_station(scenario, seed=3)
    try:
        cad, truth = station.cad, station.truth
        assert isinstance(cad, Part)
        assert isinstance(truth.workpiece, Part)
        assert truth.X_BP is not None
        assert scenario.workpiece is not None
        off = truth.X_BP.translation() - scenario.workpiece.pose_guess.pose().translation()
        assert float(np.linalg.norm(off)) == pytest.approx(0.006)
        bow = np.linalg.norm(truth.workpiece.seam_P - cad.seam_P, axis=1)
        assert bow.max() == pytest.approx(0.0005, abs=1e-6)
        servo = servo_config(scenario, station)
        assert servo.tool.side_offset_m == pytest.approx(-seated_tip(station).aside_m)
        assert servo.deflection.delta_d_m < 0.0011  # a wide joint: 2 mm would climb its wall
        assert servo.deflection.axial_d_m == pytest.approx(0.004)
        assert servo.touch.offset_m == 0.0
    finally:
        station.close()


def test_several_seams_lie_on_one_part_in_their_order(cell: Path) -> None:
    (cell.parent / "far.csv").write_text("-100,5,0\n100,5,0\n")
    text = cell.read_text().replace(
        "{polyline: straight_web.csv}",
        "{polyline: straight_web.csv, end_mm: 60}, {polyline: far.csv, direction: reverse, start_mm: 50}",
    )
    two = cell.with_name("two.yaml")
    two.write_text(text)
    scenario = load_scenario(str(two))
    assert job_plan(scenario).seams == 2
    station = make_station(scenario, seed=3)
    try:
        cad, true = station.cad, station.truth.workpiece
        assert isinstance(cad, Part)
        assert true is not None
        assert seam_count(cad) == 2
        first, second = numbered(cad, 0), numbered(cad, 1)
        assert 1e3 * first.seam_P[[0, -1], :2] == pytest.approx(np.array([[-100.0, -5.0], [40.0, -5.0]]), abs=0.1)
        # Of the reversed seam the start that is cut off is that of the travel.
        assert 1e3 * second.seam_P[[0, -1], :2] == pytest.approx(np.array([[50.0, 5.0], [-100.0, 5.0]]), abs=0.1)
        # One bow of the part moves both, and the tip feels both.
        bow = [numbered(true, k).seam_P[70] - numbered(cad, k).seam_P[70] for k in (0, 1)]
        assert min(float(np.linalg.norm(b)) for b in bow) > 1e-4
        assert bow[0] @ bow[1] > 0.9 * float(np.linalg.norm(bow[0]) * np.linalg.norm(bow[1]))
        assert np.ptp(true.groove_mesh.vertices[:, 1]) > 0.02
        # The first ends where the joint goes on, the second with the part.
        ends = [servo_config(scenario, station, k).gap.end_window_m for k in (0, 1)]
        assert ends[0] < ends[1]
    finally:
        station.close()


def test_a_press_that_climbs_out_is_refused(cell: Path) -> None:
    scenario = load_scenario(str(cell), "welding: {deflection_mm: 2.5, axial_deflection_mm: 3.0}")
    with pytest.raises(InputError, match="climbs out"):
        make_station(scenario, seed=0)


def test_a_square_tube_is_welded_leg_by_leg(tmp_path: Path) -> None:
    """Across a sharp outside corner tip and torch cannot both follow; a rectangle that is drawn on a plate's edge is
    closed."""
    tube = less(box((-30, -20, 0), (60, 40, 50)), box((-26, -16, -1), (52, 32, 60)))
    write_step(assembly(box((-90, -90, -10), (180, 180, 10)), tube), tmp_path / "tube.step")
    shape = read_shape(tmp_path / "tube.step")
    joint = max(shape.joints, key=lambda j: j.length_m)
    spec = WorkpieceConfig(
        file=str(tmp_path / "tube.step"), seams=[SeamConfig(edges=list(joint.edges))], joint="fillet"
    )
    part = part_of(spec)
    assert seam_count(part) == 4
    assert job_plan(Scenario(workpiece=spec), part).seams == 4
    corners = 1e3 * np.array([numbered(part, k).seam_P[[0, -1]] for k in range(4)])
    lengths = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    assert sorted(lengths) == pytest.approx([40.0, 40.0, 60.0, 60.0], abs=0.2)
    assert np.abs(corners[..., 0]) == pytest.approx(np.full((4, 2), 30.0), abs=0.15)
    assert np.abs(corners[..., 1]) == pytest.approx(np.full((4, 2), 20.0), abs=0.15)
    assert np.linalg.norm(corners[1:, 0] - corners[:-1, 1], axis=1).max() < 0.2  # one leg begins where the other ends
    for k in range(4):
        up = numbered(part, k).up_P
        assert (up @ up[len(up) // 2]).min() > 0.999
        assert up[0, 2] == pytest.approx(np.sqrt(0.5), abs=0.02)


def test_the_end_of_a_sheet_is_too_short_a_leg_and_the_advice_is_taken(tmp_path: Path) -> None:
    write_step(assembly(box((-90, -90, -10), (180, 180, 10)), box((-50, -4, 0), (100, 8, 40))), tmp_path / "web.step")
    (joint,) = read_shape(tmp_path / "web.step").joints
    spec = WorkpieceConfig(file=str(tmp_path / "web.step"), seams=[SeamConfig(edges=list(joint.edges))], joint="fillet")
    with pytest.raises(InputError, match="only 8 mm long") as refused:
        part_of(spec)
    advice = yaml.safe_load(str(refused.value).partition("seams: ")[2].rpartition("seams: ")[2].partition(", or")[0])
    assert seam_count(part_of(replace(spec, seams=[SeamConfig(**seam) for seam in advice]))) == 2
    unfelt = [SeamConfig(edges=list(joint.edges), feel=False)]
    assert seam_count(part_of(replace(spec, seams=unfelt))) == 4


def test_the_search_reaches_beyond_the_root_of_a_wide_groove(tmp_path: Path) -> None:
    """From the face beside it: 9.6 mm and the ball to the root, and the wanted deflection beyond."""
    half = [(0.0, 0.0, 0.0), (0.0, 100.0, 0.0), (0.0, 100.0, 21.0), (0.0, 9.6, 21.0), (0.0, 0.0, 2.0)]
    sides = [prism([(x, side * y, z) for x, y, z in half], (120.0, 0.0, 0.0)) for side in (1.0, -1.0)]
    write_step(assembly(*sides), tmp_path / "v.step")
    (seam,) = [j for j in read_shape(tmp_path / "v.step").joints if j.type == "V"]
    scenario = load_scenario("straight_groove")
    scenario.workpiece = WorkpieceConfig(
        file=str(tmp_path / "v.step"), seams=[SeamConfig(edges=list(seam.edges))], joint="v_groove"
    )
    station = make_station(scenario, seed=0)
    try:
        config = servo_config(scenario, station)
    finally:
        station.close()
    assert config.touch.offset_m < -0.0096
    assert config.touch.range_m > -config.touch.offset_m + config.deflection.delta_d_m + 0.003


def test_a_part_lies_off_by_its_middle_and_not_by_the_origin_of_its_file(cell: Path, tmp_path: Path) -> None:
    """1.5 deg about an origin that is 3 m away would be 78 mm."""
    angle = np.array([[0.0, 0.0], [80.0, 0.0], [80.0, 10.0], [10.0, 10.0], [10.0, 60.0], [0.0, 60.0]])
    path = tmp_path / "far.obj"
    path.write_text(extrude(angle + np.array([3000.0, 0.0]), 0.0, 150.0).to_obj())
    scenario = load_scenario(str(cell))
    assert scenario.workpiece is not None
    scenario.workpiece = replace(
        scenario.workpiece,
        file=str(path),
        units=None,
        seams=[SeamConfig(edges=[1])],
        placement_error=ErrorConfig(6.0, 1.5),
    )
    station = make_station(scenario, 0)
    try:
        middle = np.array([3.04, 0.03, 0.075])
        assert station.truth.X_BP is not None
        guess = scenario.workpiece.pose_guess.pose()
        off = station.truth.X_BP.multiply(middle) - guess.multiply(middle)
        assert np.linalg.norm(off) == pytest.approx(0.006, abs=1e-9)
        turned = guess.rotation().inverse() @ station.truth.X_BP.rotation()
        assert np.degrees(turned.ToAngleAxis().angle()) == pytest.approx(1.5)
    finally:
        station.close()


@pytest.mark.parametrize("direction", ["forward", "reverse"])
def test_a_butt_around_a_tube_is_welded_leg_by_leg(direction: str, tmp_path: Path) -> None:
    """Its faces are level in each leg only."""
    tubes = [less(box((x, 0, 0), (100, 40, 60)), box((x - 1, 3, 3), (102, 34, 54))) for x in (0, 101)]
    write_step(assembly(*tubes), tmp_path / "tubes.step")
    joint = max(read_shape(tmp_path / "tubes.step").joints, key=lambda j: j.length_m)
    seam = SeamConfig(edges=list(joint.edges), direction=direction, start_mm=5.0, end_mm=10.0)
    part = part_of(WorkpieceConfig(file=str(tmp_path / "tubes.step"), seams=[seam], joint="butt"))
    assert seam_count(part) == 4
    legs = [numbered(part, k) for k in range(4)]
    ends = 1e3 * np.array([leg.seam_P[[0, -1]] for leg in legs])
    assert ends[..., 0] == pytest.approx(np.full((4, 2), 100.5), abs=0.01)  # the middle of the gap
    assert ends[1:, 0] == pytest.approx(ends[:-1, 1], abs=0.1)
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum() == pytest.approx(2 * (40 + 60) - 15, abs=0.5)
    assert np.linalg.norm(ends[0, 0] - ends[-1, 1]) == pytest.approx(np.hypot(5.0, 10.0), abs=0.5)
    for leg in legs:
        outwards = leg.seam_P[len(leg.seam_P) // 2] - [0.1005, 0.02, 0.03]
        assert leg.up_P[0] @ outwards > 0.015
