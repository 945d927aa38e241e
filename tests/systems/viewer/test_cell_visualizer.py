"""What a person sees: Meshcat gets a board for every phase, each belief as it comes, and a recording that opens by itself."""

from __future__ import annotations

import base64
import re

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from scipy.spatial import ConvexHull

from tests.systems.cells import TOOL, scenario
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.mesh import TriMesh
from weldcal.models.outline import outline
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.jobs.weld.sequencer import PHASES, JobState
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, JobCommand, PlannedSeam, Scan
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.cell_visualizer import ALL_PHASES, ROOT, CellVisualizer
from weldcal.systems.viewer.phase_labels import TEXT, label_image
from weldcal.systems.viewer.weld_gauge import gauge_picture
from weldcal.welding.seam.curve import SeamCurve
from weldcal.welding.servo.state import Diagnostics, Measurement, Phase, WeldingCommand, WeldingState


@pytest.fixture(scope="module")
def meshcat() -> Meshcat:
    """One Meshcat for this machine alone, at whatever port is free."""
    return Meshcat(MeshcatParams(host="localhost", port=0))


@pytest.fixture(scope="module")
def recorded(meshcat: Meshcat) -> Cell:
    """The S groove's cell after its first 0.3 s, recorded."""
    cell = build_cell(scenario(), 0, meshcat)
    meshcat.StartRecording(frames_per_second=10.0, set_visualizations_while_recording=False)
    simulator = Simulator(cell.diagram)
    simulator.AdvanceTo(0.3)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return cell


@pytest.mark.usefixtures("recorded")
def test_every_phase_has_its_board_in_the_scene(meshcat: Meshcat) -> None:
    for phase in ALL_PHASES:
        assert meshcat.HasPath(f"{ROOT}/phase/{phase}")


@pytest.mark.usefixtures("recorded")
def test_the_arm_and_the_scanners_guess_are_in_the_scene(meshcat: Meshcat) -> None:
    assert meshcat.HasPath("/drake/cell")
    assert meshcat.HasPath(f"{ROOT}/camera/guess")


@pytest.mark.usefixtures("recorded")
def test_the_recording_is_one_page_with_the_boards_in_it(meshcat: Meshcat) -> None:
    page = meshcat.StaticHtml()
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert not re.search(r"<(script|link)[^>]*(src|href)=.https?:", page)  # it opens with no network
    # The page carries what was sent to the browser as base64 of binary messages.
    pieces = re.findall(r"[A-Za-z0-9+/]{200,}={0,2}", page)
    sent = b"".join(base64.b64decode(piece) for piece in pieces if len(piece) % 4 == 0)
    for phase in ALL_PHASES:
        assert f"{ROOT}/phase/{phase}".encode() in sent
        assert f"map_Kd phase_{phase}.png".encode() in sent
    assert sent.count(b"data:image/png;base64,iVBORw0K") >= len(ALL_PHASES)  # their pictures, and not their names alone
    assert b"set_animation" in sent


def test_the_viewer_listens_on_this_machine_only(meshcat: Meshcat) -> None:
    assert meshcat.web_url().startswith("http://localhost:")


def test_every_phase_has_words_and_a_board_that_shows_them() -> None:
    assert set(ALL_PHASES) == {*PHASES, "done", "held"} == set(TEXT)
    for phase, text in TEXT.items():
        board = label_image(text)
        assert board.shape == (128, 1024, 3), phase
        bright = np.argwhere(board.max(axis=2) > 200)
        assert len(bright) > 300
        # The whole line fits: nothing touches the board's ends.
        assert bright[:, 1].min() > 8
        assert bright[:, 1].max() < 1015


PLATE = make_workpiece("straight")


class Viewer:
    """The visualizer alone, shown messages by hand."""

    def __init__(self, meshcat: Meshcat) -> None:
        meshcat.Delete(ROOT)
        self.meshcat = meshcat
        guess = RigidTransform([0.65, 0.0, 0.95])
        self.system = CellVisualizer(meshcat, TOOL, guess, 0.0315, VisualizationConfig(cloud_points=50), PLATE.mesh)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.show(
            job_state=JobState(),
            calibration_status=CalibrationStatus(),
            flange_estimate=FlangeEstimate(),
            scan=Scan(),
            planned_seam=PlannedSeam(),
            servo_report=ServoReport(),
        )
        self.simulator.Initialize()

    def show(self, **messages: object) -> None:
        for name, message in messages.items():
            self.system.GetInputPort(name).FixValue(self.context, AbstractValue.Make(message))

    def run(self, duration: float) -> None:
        self.simulator.AdvanceTo(self.context.get_time() + duration)

    def has(self, path: str) -> bool:
        return bool(self.meshcat.HasPath(f"{ROOT}/{path}"))


@pytest.fixture
def viewer(meshcat: Meshcat, recorded: Cell) -> Viewer:
    assert recorded.diagram.HasSubsystemNamed("cell_visualizer")
    return Viewer(meshcat)


def test_a_scan_appears_when_it_comes(viewer: Viewer) -> None:
    viewer.run(0.15)
    assert not viewer.has("scan/01")
    points = np.random.default_rng(0).uniform(0.1, 0.2, (20, 30, 3)).astype(np.float32)
    points[0] = np.nan
    viewer.show(scan=Scan(1, 0.1, points))
    viewer.run(0.15)
    assert viewer.has("scan/01")
    assert not viewer.has("scan/02")


def test_a_fitted_circle_appears_and_a_refused_one_does_not(viewer: Viewer) -> None:
    viewer.show(flange_estimate=FlangeEstimate(1, 0.0, "calibrate", "pose01", reason="no rim was seen"))
    viewer.run(0.15)
    assert not viewer.has("circle/01")
    fit = FlangeFit(
        np.array([0.0, 0.0, 0.6]),
        np.array([0.0, 0.0, -1.0]),
        np.eye(3) * 1e-10,
        1e-4,
        1e-5,
        1e-5,
        0.0315,
        None,
        900,
        90,
        0.9,
    )
    viewer.show(flange_estimate=FlangeEstimate(2, 0.0, "calibrate", "pose02", fit))
    viewer.run(0.15)
    assert viewer.has("circle/02")


SEAM = SeamCurve.from_points(np.column_stack([np.full(30, 0.65), np.linspace(-0.1, 0.1, 30), np.zeros(30)]))


def test_the_planned_seam_appears_with_the_drawing_where_it_was_found(viewer: Viewer) -> None:
    viewer.show(planned_seam=PlannedSeam(1, SEAM), job_state=JobState(JobCommand(phase="approach_above")))
    viewer.run(0.15)
    assert viewer.has("seam/planned")
    assert not viewer.has("cad"), "no registration, no drawing"
    viewer.show(planned_seam=PlannedSeam(2, SEAM, RigidTransform([0.65, 0.0, 0.02])))
    viewer.run(0.15)
    assert viewer.has("cad")
    assert not viewer.has("seam/torch/000")
    assert not viewer.has("gauge/000")


def tracking(time: float, s: float, torch_on: bool) -> ServoReport:
    """A report from the middle of a weld along the seam: the torch at arc length s, the tip 2 mm off its rest."""
    figures = Diagnostics(s_torch=s, n_d_dot_n_t=0.9, p_BTip=SEAM.position(s + 0.06))
    command = WeldingCommand(np.zeros(6), torch_on, Phase.TRACK, None, figures)
    delta = np.array([-0.002, 0.0, -0.003])
    p_BT = SEAM.position(s + 0.06) + delta
    felt = Measurement(time, SEAM.position(s + 0.06), delta, p_BT)
    state = WeldingState(phase=Phase.TRACK, measurement=felt)
    return ServoReport(
        "TRACK", torch_on, None, command, state, time, RigidTransform(RollPitchYaw(0, 0, np.pi / 2), p_BT)
    )


def test_the_weld_grows_piece_by_piece_with_its_gauge_and_the_arrow_of_the_deflection(viewer: Viewer) -> None:
    viewer.show(planned_seam=PlannedSeam(1, SEAM, RigidTransform()))
    for k in range(25):
        viewer.show(servo_report=tracking(0.1 * k, 0.0008 * k, k > 3))
        viewer.run(0.1)
    assert viewer.has("deflection/arrow/unit/head")
    for path in ("seam/torch/001", "seam/tip/001", "gauge/001"):
        assert viewer.has(path), path
    assert not viewer.has("gauge/005"), "a piece a second, and not one a frame"
    assert not viewer.has("seam/refined/000"), "no point was committed"


def test_a_viewer_that_is_only_looked_at_changes_nothing(viewer: Viewer) -> None:
    viewer.run(0.15)
    assert viewer.context.num_abstract_states() == 0
    assert viewer.context.num_total_states() == 0


def test_the_gauge_shows_the_speed_where_the_arc_burned() -> None:
    s = np.linspace(-0.06, 0.1, 80)
    speed, measure = np.where(s > 0.0, 0.008, np.nan), np.cos(8.0 * s)
    board = gauge_picture(s, speed, measure, 0.2, 0.008)
    orange = (np.abs(board.astype(int) - [66, 145, 242]).max(axis=2) < 30).nonzero()
    blue = (np.abs(board.astype(int) - [235, 190, 110]).max(axis=2) < 30).nonzero()
    width = board.shape[1]
    # 0.26 m of seam on the board: the arc burns from 23 % of it to 62 %, the other curve begins at its left edge.
    assert 0.24 < orange[1].min() / width < 0.30
    assert 0.60 < orange[1].max() / width < 0.66
    assert blue[1].min() / width < 0.08
    assert orange[0].max() < blue[0].min(), "speed above, measure below"


@pytest.mark.parametrize("n", [0, 1])
def test_a_gauge_of_nothing_is_a_board_all_the_same(n: int) -> None:
    assert gauge_picture(np.zeros(n), np.full(n, np.nan), np.zeros(n), 0.2, 0.008).std() > 1.0


def test_the_outline_of_a_box_is_its_twelve_edges() -> None:
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
    faces = ConvexHull(corners)
    inside = corners.mean(axis=0)
    triangles = [
        t if np.cross(*(corners[t[1:]] - corners[t[0]])) @ (corners[t[0]] - inside) > 0 else t[::-1]
        for t in faces.simplices
    ]
    starts, ends = outline(TriMesh(corners, np.array(triangles)))
    lengths = np.linalg.norm(ends - starts, axis=1)
    assert sorted(lengths) == pytest.approx([1.0] * 4 + [2.0] * 4 + [3.0] * 4)
    one = TriMesh(corners[:3], np.array([[0, 1, 2]]))
    assert len(outline(one)[0]) == 3, "an open face ends at its edges"
