"""What an operator sees: Meshcat gets a board for every phase, each belief as it comes, and a recording that opens by
itself."""

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
from weldcal.calibration.eye_on_base.estimate import CalibrationEstimate, HeldOut
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.calibration.flange.observation import Observation
from weldcal.models.mesh import TriMesh
from weldcal.models.scanners import get_scanner
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.systems.cell import Cell, build_cell
from weldcal.systems.jobs.weld.sequencer import PHASES, JobState
from weldcal.systems.jobs.weld.welding_velocity_servo import ServoReport
from weldcal.systems.messages import CalibrationStatus, FlangeEstimate, PlannedSeam, Scan
from weldcal.systems.phase_words import TEXT
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.cell_visualizer import ROOT, CellVisualizer, face_residuals
from weldcal.systems.viewer.scene import diverging, uncertainty_at
from weldcal.systems.viewer.weld_view import outline
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
def test_the_arm_and_the_scanners_guess_are_in_the_scene(meshcat: Meshcat) -> None:
    assert meshcat.HasPath("/drake/cell")
    assert meshcat.HasPath(f"{ROOT}/guess/triad/axis0/1"), "a guess is dashed"
    assert meshcat.HasPath(f"{ROOT}/estimate/cone/edges")


@pytest.mark.usefixtures("recorded")
def test_the_recording_is_one_page_that_needs_no_network(meshcat: Meshcat) -> None:
    page = meshcat.StaticHtml()
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert not re.search(r"<(script|link)[^>]*(src|href)=.https?:", page)
    # The page carries what was sent to the browser as base64 of binary messages.
    pieces = re.findall(r"[A-Za-z0-9+/]{200,}={0,2}", page)
    sent = b"".join(base64.b64decode(piece) for piece in pieces if len(piece) % 4 == 0)
    assert f"{ROOT}/guess/sign".encode() in sent
    assert b"data:image/png;base64,iVBORw0K" in sent, "the picture of a sign, and not its name alone"
    assert b"set_animation" in sent


def test_the_viewer_listens_on_this_machine_only(meshcat: Meshcat) -> None:
    assert meshcat.web_url().startswith("http://localhost:")


def test_every_phase_has_words() -> None:
    assert set(TEXT) == {*PHASES, "done", "held"}


PLATE = make_workpiece("straight")
WORK = np.array([0.65, 0.0, 0.02])


class Viewer:
    """The visualizer alone, shown messages by hand."""

    def __init__(self, meshcat: Meshcat) -> None:
        meshcat.Delete(ROOT)
        self.meshcat = meshcat
        guess = RigidTransform([0.65, 0.0, 0.95])
        self.system = CellVisualizer(
            meshcat=meshcat,
            tool=TOOL,
            X_BC_guess=guess,
            circle_radius_m=0.0315,
            config=VisualizationConfig(cloud_points=50),
            cad=PLATE.mesh,
            scanner=get_scanner("phoxi_m"),
            work_B=WORK,
        )
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
    assert not viewer.has("estimate/scan/01")
    points = np.random.default_rng(0).uniform(0.1, 0.2, (20, 30, 3)).astype(np.float32)
    points[0] = np.nan
    viewer.show(scan=Scan(1, 0.1, points))
    viewer.run(0.15)
    assert viewer.has("estimate/scan/01")
    assert not viewer.has("estimate/scan/02")


FIT = FlangeFit(
    center_C=np.array([0.0, 0.0, 0.6]),
    normal_C=np.array([0.0, 0.0, -1.0]),
    center_covariance=np.eye(3) * 1e-10,
    normal_sigma=1e-4,
    plane_rms_m=1e-5,
    rim_rms_m=1e-5,
    outer_radius_m=0.0315,
    bore_radius_m=None,
    n_points=900,
    coverage=0.9,
)
X_BC = RigidTransform(RollPitchYaw(np.pi, 0.0, -np.pi / 2), [0.65, 0.0, 0.95])


def calibrated(sigma_m: float, inliers: list[bool], above_m: float = 0.0) -> CalibrationStatus:
    """A calibration by as many scans, whose flange face was seen `above_m` above the arm's; isotropic error of the
    position."""
    n = len(inliers)
    X_BR = X_BC @ RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.0, 0.0, 0.6 + above_m])
    seen = tuple(Observation(f"pose{k + 1:02d}", X_BR, FIT.center_C) for k in range(n))
    covariance = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]) * sigma_m**2
    zeros = np.zeros(n)
    estimate = CalibrationEstimate(
        X_BC=X_BC,
        covariance=covariance,
        inliers=np.array(inliers),
        position_residuals_m=zeros,
        tilt_residuals_rad=zeros,
        held_out=HeldOut(zeros, zeros),
        sigma_position_m=1e-4,
        sigma_normal_rad=1e-3,
        unobservable=(),
        warnings=(),
    )
    return CalibrationStatus(sequence=n, calibration_scans=n, observations=seen, estimate=estimate)


def test_a_fitted_circle_appears_with_its_number_and_none_without_a_fit(viewer: Viewer) -> None:
    viewer.show(
        flange_estimate=FlangeEstimate(
            sequence=1, capture_time=0.0, purpose="calibrate", label="pose01", reason="no rim was seen"
        )
    )
    viewer.run(0.15)
    assert not viewer.has("estimate/circle/01")
    viewer.show(
        flange_estimate=FlangeEstimate(sequence=2, capture_time=0.0, purpose="calibrate", label="pose02", fit=FIT)
    )
    viewer.run(0.15)
    assert viewer.has("estimate/circle/02/number")


def test_circles_fade_with_age_and_refused_ones_are_dashed(viewer: Viewer) -> None:
    for k in range(1, 7):
        viewer.show(
            flange_estimate=FlangeEstimate(
                sequence=k, capture_time=0.0, purpose="calibrate", label=f"pose{k:02d}", fit=FIT
            )
        )
        viewer.run(0.15)
    circles = viewer.system._drawn.circles
    assert [circles[k].showing for k in range(1, 7)] == ["old", "old", "recent", "recent", "recent", "new"]
    viewer.show(calibration_status=calibrated(1e-4, [True, False, True, True, True, True]))
    viewer.run(0.15)
    assert [circles[k].showing for k in (1, 2, 6)] == ["old", "refused", "new"]


def test_an_estimate_is_solid_and_its_error_stands_at_the_work_point(viewer: Viewer) -> None:
    viewer.run(0.15)
    assert not viewer.has("error/at_work_point/ball")
    viewer.show(calibration_status=calibrated(1e-4, [True] * 4))
    viewer.run(0.15)
    assert viewer.has("estimate/triad/axis0/0")
    assert not viewer.has("estimate/triad/axis0/1")
    assert viewer.has("error/at_work_point/sign/200"), "0.3 mm at 3 sigma: 60 mm"


@pytest.mark.parametrize(("sigma_mm", "times"), [(0.1, 200), (0.2, 100), (3.0, 10), (100.0, 1)])
def test_the_drawn_error_is_magnified_as_far_as_there_is_space(sigma_mm: float, times: int) -> None:
    estimate = calibrated(1e-3 * sigma_mm, [True] * 4).estimate
    assert estimate is not None
    found = uncertainty_at(estimate, WORK)
    np.testing.assert_allclose(found.half_axes, 3e-3 * sigma_mm)
    assert found.magnification == times


def test_a_face_that_is_seen_too_near_the_scanner_is_above_where_the_arm_puts_it() -> None:
    status = calibrated(1e-4, [True] * 4, above_m=2e-4)  # the arm's face is farther from the scanner
    np.testing.assert_allclose(face_residuals(FIT.center_C[None], status), [2e-4], atol=1e-9)
    blue, white, red = diverging(np.array([-1.0, 0.0, 1.0])).astype(int)
    assert blue[2] > blue[0]
    assert red[0] > red[2]
    assert white.min() > 240


def test_the_newest_face_is_coloured_once_the_calibration_has_used_it(viewer: Viewer) -> None:
    face = FIT.center_C + np.random.default_rng(0).normal(0.0, 1e-3, (200, 3))
    viewer.show(
        flange_estimate=FlangeEstimate(
            sequence=4, capture_time=0.0, purpose="calibrate", label="pose04", fit=FIT, points_C=face
        )
    )
    viewer.run(0.15)
    assert not viewer.has("estimate/face/04")
    viewer.show(calibration_status=calibrated(1e-4, [True] * 4))
    viewer.run(0.15)
    assert viewer.has("estimate/face/04")


SEAM = SeamCurve.from_points(np.column_stack([np.full(30, 0.65), np.linspace(-0.1, 0.1, 30), np.zeros(30)]))


def test_the_planned_seam_appears_with_the_drawing_where_it_was_found(viewer: Viewer) -> None:
    viewer.show(planned_seam=PlannedSeam(sequence=1, seam=SEAM), job_state=JobState(phase="approach_above"))
    viewer.run(0.15)
    assert viewer.has("seam/planned")
    assert not viewer.has("cad"), "no registration, no drawing"
    viewer.show(planned_seam=PlannedSeam(sequence=2, seam=SEAM, X_BP=RigidTransform([0.65, 0.0, 0.02])))
    viewer.run(0.15)
    assert viewer.has("cad")
    assert not viewer.has("seam/torch/000")


def tracking(time: float, s: float, torch_on: bool) -> ServoReport:
    """A report from the middle of a weld along the seam: the torch at arc length s, the tip 2 mm off its rest."""
    figures = Diagnostics(s_torch=s, n_d_dot_n_t=0.9, p_BTip=SEAM.position(s + 0.06))
    command = WeldingCommand(np.zeros(6), torch_on, Phase.TRACK, None, figures)
    delta = np.array([-0.002, 0.0, -0.003])
    p_BT = SEAM.position(s + 0.06) + delta
    felt = Measurement(time, SEAM.position(s + 0.06), delta, p_BT)
    state = WeldingState(phase=Phase.TRACK, measurement=felt)
    return ServoReport(
        phase="TRACK",
        torch_on=torch_on,
        reason=None,
        command=command,
        state=state,
        time=time,
        X_BT=RigidTransform(RollPitchYaw(0, 0, np.pi / 2), p_BT),
    )


def test_the_weld_grows_piece_by_piece_with_the_arrow_of_the_deflection(viewer: Viewer) -> None:
    viewer.show(planned_seam=PlannedSeam(sequence=1, seam=SEAM, X_BP=RigidTransform()))
    for k in range(25):
        viewer.show(servo_report=tracking(0.1 * k, 0.0008 * k, k > 3))
        viewer.run(0.1)
    assert viewer.has("deflection/arrow/unit/head")
    for path in ("seam/torch/001", "seam/felt/001"):
        assert viewer.has(path), path
    assert not viewer.has("seam/felt/006"), "two pieces a second, and not one a frame"


def test_a_viewer_that_is_only_looked_at_changes_nothing(viewer: Viewer) -> None:
    viewer.run(0.15)
    assert viewer.context.num_abstract_states() == 0
    assert viewer.context.num_total_states() == 0


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
