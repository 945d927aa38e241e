"""The finger camera and its tag: a known push of the tip is read back, late but with its own time, and never
invented."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import ClippingRange, ColorRenderCamera, RenderCameraCore
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import CameraInfo

from tests.systems.cells import Q_HOME, TOOL, Drive, plain_station, scenario, the_arm
from weldcal.models.arms.kinematics import forward_kinematics
from weldcal.systems.drivers.simulated.rendered_finger_camera import (
    Pixels,
    RenderedFingerCamera,
    StreamingCamera,
    TagView,
)
from weldcal.systems.jobs.weld.aruco_deformation_estimator import (
    ArucoDeformationEstimator,
    Deformation,
    measure_deformation,
)
from weldcal.systems.messages import Image
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.welding.finger.deformation import TagModel, tag_cells

TAG = TagModel(dictionary=TOOL.tag_dictionary, id=TOOL.tag_id, size_m=TOOL.tag_size_m)
CAMERA = RenderedFingerCamera().camera()
MM = 1e-3
PUSHES_MM = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 3.0), (-0.8, -2.0, 3.0), (0.4, 1.1, 4.2)]


def rendered(push_m: np.ndarray) -> Image:
    """The camera's first frame with the tip held off its rest by `push_m` (3,) in T."""
    drive = Drive(plain_station())
    drive.set("finger_camera.streaming", [1.0])
    drive.place_arm(Q_HOME, push_m)
    drive.run(CAMERA.latency_s + 0.001)  # the frame is of the first moment, before the springs move
    image: Image = drive.get("finger_camera.image")
    return image


def drawn(deflection_T: np.ndarray, scale: int = 8) -> np.ndarray:
    """What a camera would see of the tag with the tip off its rest, drawn by OpenCV: smooth edges, a little noise."""
    inner = np.kron(tag_cells(TAG).astype(np.uint8) * 255, np.ones((40, 40), np.uint8))
    cells = cv2.copyMakeBorder(inner, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    n = cells.shape[0]
    half = 0.5 * TAG.size_m * n / (n - 120)
    corners_M = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    X_KM = TOOL.X_FK.inverse() @ TOOL.X_FT @ RigidTransform(deflection_T) @ TOOL.X_FT.inverse() @ TOOL.X_FM_rest
    p = (X_KM @ corners_M.T).T
    K = CAMERA.camera_matrix
    pixels = p[:, :2] / p[:, 2:] * np.diag(K)[:2] + K[:2, 2]
    # Pixel corners, not centres, are scaled when the picture is drawn larger and shrunk by area.
    target = ((pixels + 0.5) * scale).astype(np.float32)
    source = np.array([[0, 0], [n, 0], [n, n], [0, n]], dtype=np.float32)
    shift = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    H = shift @ cv2.getPerspectiveTransform(source, target) @ np.linalg.inv(shift)
    big = cv2.warpPerspective(cells, H, (CAMERA.width * scale, CAMERA.height * scale), borderValue=70)
    smooth = cv2.resize(big, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
    noise = CAMERA.noise_grey * np.random.default_rng(0).standard_normal(smooth.shape)
    return np.asarray(np.clip(smooth + noise, 0, 255), dtype=np.uint8)


def read(image: Image) -> Deformation:
    return measure_deformation(image, forward_kinematics(the_arm(), Q_HOME), TOOL, TAG, CAMERA.camera_matrix)


@pytest.mark.parametrize("push_mm", [(0.0, 0.0, 0.0), (2.0, -3.0, 4.0), (-6.0, 5.0, -3.0)])
def test_its_picture_is_the_cells_as_a_renderer_sees_it_from_the_tool(push_mm: tuple[float, float, float]) -> None:
    """The homography of the print against the renderer's picture of the whole cell, from the same place."""
    drive = Drive(plain_station())
    drive.place_arm(Q_HOME, MM * np.array(push_mm))
    world = drive.station.world
    c, K, view = CAMERA, CAMERA.camera_matrix, world.scanner_view
    info = CameraInfo(c.width, c.height, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)
    plate = world.plant.GetBodyByName("tool_plate", world.tool).index()
    core = RenderCameraCore(view.renderer, info, ClippingRange(0.005, 0.5), RigidTransform())
    query = view.scene_graph.get_query_output_port().Eval(view.scene_graph.GetMyContextFromRoot(drive.context))
    whole = query.RenderColorImage(ColorRenderCamera(core), view.frames[plate], TOOL.X_FK).data.copy()
    poses = world.plant.get_body_poses_output_port().Eval(world.plant.GetMyContextFromRoot(drive.context))
    tip = poses[world.plant.GetBodyByName("tip_z", world.tool).index()]
    X_FM = poses[plate].InvertAndCompose(tip) @ TOOL.X_FT.InvertAndCompose(TOOL.X_FM_rest)
    ours, theirs = TagView(TOOL, c).picture(X_FM), np.ascontiguousarray(whole[:, :, 1])
    # They differ at edges alone, which a renderer samples at points: neither is shifted, nor lighter than the other.
    difference = ours.astype(float) - theirs
    assert np.mean(np.abs(difference) > 30.0) < 0.01
    assert abs(np.mean(difference)) < 1.5
    assert np.ptp(theirs) > 200, "the tag is in it"
    one, other = (read(Image(1, 0.0, picture)).sample for picture in (ours, theirs))
    assert one is not None
    assert other is not None
    assert one.deflection_T[:2] == pytest.approx(other.deflection_T[:2], abs=0.001 * MM)
    assert one.deflection_T[2] == pytest.approx(other.deflection_T[2], abs=0.006 * MM)


@pytest.mark.parametrize("push_mm", PUSHES_MM)
def test_a_push_of_the_drawn_tag_is_read_back(push_mm: tuple[float, float, float]) -> None:
    push = MM * np.array(push_mm)
    answer = read(Image(4, 1.5, drawn(push)))
    assert answer.sample is not None
    assert answer.sample.valid, answer.reason
    assert answer.sequence == 4
    assert answer.sample.capture_time == 1.5
    assert answer.sample.X_BT_at_capture.IsNearlyEqualTo(forward_kinematics(the_arm(), Q_HOME) @ TOOL.X_FT, 1e-12)
    # A side is found to a hundredth of a pixel, 0.001 mm at 40 mm; along the line of sight that is 0.02 px in 112 px of
    # 40 mm.
    assert answer.sample.deflection_T[:2] == pytest.approx(push[:2], abs=0.003 * MM)
    assert answer.sample.deflection_T[2] == pytest.approx(push[2], abs=0.01 * MM)


@pytest.mark.parametrize("push_mm", PUSHES_MM)
def test_a_push_of_the_rendered_tag_is_read_back(push_mm: tuple[float, float, float]) -> None:
    push = MM * np.array(push_mm)
    answer = read(rendered(push))
    assert answer.sample is not None
    assert answer.sample.valid, answer.reason
    assert answer.sample.deflection_T[:2] == pytest.approx(push[:2], abs=0.005 * MM)
    assert answer.sample.deflection_T[2] == pytest.approx(push[2], abs=0.02 * MM)


def test_the_rendered_tag_is_read_without_a_great_bias_on_average() -> None:
    errors = []
    for push_mm in PUSHES_MM[1:]:
        sample = read(rendered(MM * np.array(push_mm))).sample
        assert sample is not None
        errors.append(sample.deflection_T - MM * np.array(push_mm))
    assert np.abs(np.mean(errors, axis=0)[:2]).max() < 0.002 * MM
    assert abs(np.mean(errors, axis=0)[2]) < 0.01 * MM, "corners refined one by one read 0.23 mm too near"


@pytest.mark.parametrize("what", ["dark", "half covered", "another tag"])
def test_without_the_tag_there_is_a_reason_and_no_number(what: str) -> None:
    picture = drawn(np.zeros(3))
    if what == "dark":
        picture = np.full_like(picture, 25)
    elif what == "half covered":
        picture[:, CAMERA.width // 2 :] = 25
    answer = measure_deformation(
        Image(2, 0.3, picture),
        RigidTransform(),
        TOOL,
        TagModel(dictionary=TAG.dictionary, id=TAG.id + 1, size_m=TAG.size_m) if what == "another tag" else TAG,
        CAMERA.camera_matrix,
    )
    assert answer.sample is not None
    assert not answer.sample.valid
    assert answer.sample.capture_time == 0.3
    assert answer.sample.deflection_T.tolist() == [0.0, 0.0, 0.0]
    assert "not visible" in answer.reason


class Bench:
    """A streaming camera alone, before a picture that the test changes."""

    def __init__(self, **changes: Any) -> None:
        config = RenderedFingerCamera(**{"width": 8, "height": 6, **changes})
        self.camera = StreamingCamera(config, 1, 0.002, self.draw)
        self.simulator = Simulator(self.camera)
        self.context = self.simulator.get_mutable_context()
        self.camera.GetInputPort("body_poses").FixValue(self.context, Value[list[RigidTransform]]([]))
        self.shape = (config.height, config.width)
        self.show(100)
        self.stream(True)

    def draw(self, _poses: list[RigidTransform]) -> Pixels:
        return np.full(self.shape, self.grey, dtype=np.uint8)

    def show(self, grey: int) -> None:
        self.grey = grey

    def stream(self, on: bool) -> None:
        self.camera.GetInputPort("streaming").FixValue(self.context, [float(on)])

    def image_at(self, time: float) -> Image:
        self.simulator.AdvanceTo(time)
        image: Image = self.camera.GetOutputPort("image").Eval(self.context)
        assert self.camera.GetOutputPort("capture_time").Eval(self.context)[0] == image.capture_time
        return image


def test_a_frame_arrives_after_its_latency_with_the_time_of_its_exposure() -> None:
    bench = Bench(rate_hz=30.0, latency_s=0.040)
    assert bench.image_at(0.039).sequence == 0
    first = bench.image_at(0.0405)
    # On a tick of the plant itself, the frame still shows the step before.
    assert (first.sequence, first.capture_time) == (1, pytest.approx(-0.002))
    later = bench.image_at(1.0 / 30.0 + 0.0405)
    assert later.sequence == 2
    # The world moves in steps: the frame shows the step before its exposure.
    assert later.capture_time == pytest.approx(0.032)


def test_frames_keep_their_rate_even_when_the_latency_spans_several() -> None:
    bench = Bench(rate_hz=50.0, latency_s=0.100)
    arrived = [bench.image_at(0.0105 + 0.02 * k).sequence for k in range(20)]
    assert arrived == [max(0, k - 4) for k in range(20)]


def test_a_frame_shows_what_was_there_at_its_exposure() -> None:
    bench = Bench(rate_hz=30.0, latency_s=0.040, noise_grey=0.0)
    bench.image_at(0.010)
    bench.show(200)
    assert bench.image_at(0.041).pixels.tolist() == np.full((6, 8), 100).tolist()
    assert bench.image_at(0.080).pixels.tolist() == np.full((6, 8), 200).tolist()


def test_it_takes_no_frames_unless_it_is_asked() -> None:
    bench = Bench()
    bench.stream(False)
    assert bench.image_at(0.3).sequence == 0


def test_its_noise_has_the_size_that_was_said_and_differs_from_frame_to_frame() -> None:
    bench = Bench(width=200, height=100, noise_grey=3.0)
    bench.show(128)
    frames = [bench.image_at(time).pixels.astype(float) for time in (0.045, 0.080)]
    # 20000 pixels give sigma to half a percent; grey values are cut to whole ones, half a grey below on average.
    assert np.std(frames[0]) == pytest.approx(3.0, rel=0.03)
    assert np.mean(frames[0]) == pytest.approx(127.5, abs=0.1)
    assert np.std(frames[1] - frames[0]) == pytest.approx(3.0 * np.sqrt(2.0), rel=0.03)


def test_spatter_hides_the_tag_from_its_moment_on() -> None:
    bench = Bench(rate_hz=50.0, latency_s=0.0, noise_grey=0.0, hidden_from_s=0.1)
    bench.stream(False)
    bench.image_at(0.205)
    bench.stream(True)  # it counts from when the camera started
    assert bench.image_at(0.305).pixels.max() == 100
    assert bench.image_at(0.345).pixels.max() == 25


class Estimator:
    """The deformation estimator alone, fed by hand."""

    def __init__(self) -> None:
        self.system = ArucoDeformationEstimator(the_arm(), TOOL, CAMERA)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.feed("image", Image())
        self.feed("history", PoseHistory(np.array([0.0, 0.01, 1.0]), np.tile(Q_HOME, (3, 1))))

    def feed(self, port: str, value: object) -> None:
        self.system.GetInputPort(port).FixValue(self.context, AbstractValue.Make(value))

    def at(self, time: float) -> tuple[Deformation, np.ndarray]:
        self.simulator.AdvanceTo(time)
        out = self.system.GetOutputPort
        return out("deformation").Eval(self.context), np.array(out("deflection").Eval(self.context))


def test_the_estimator_says_how_old_its_newest_number_is() -> None:
    estimator = Estimator()
    deformation, vector = estimator.at(0.05)
    assert deformation.sample is None
    assert vector.tolist() == [0.0, 0.0, 0.0, 0.0, np.inf]
    estimator.feed("image", Image(1, 0.02, drawn(np.array([0.0, 0.002, 0.003]))))
    _, vector = estimator.at(0.07)
    assert vector[:2] == pytest.approx([0.0, 0.002], abs=0.05 * MM)
    assert vector[3:] == pytest.approx([1.0, 0.05])
    _, vector = estimator.at(0.12)
    assert vector[4] == pytest.approx(0.10)


def test_a_hidden_tag_takes_the_place_of_the_last_good_number() -> None:
    estimator = Estimator()
    estimator.feed("image", Image(1, 0.02, drawn(np.array([0.0, 0.002, 0.003]))))
    assert estimator.at(0.05)[1][3] == 1.0
    estimator.feed("image", Image(2, 0.06, np.full((CAMERA.height, CAMERA.width), 25, np.uint8)))
    deformation, vector = estimator.at(0.10)
    assert vector[:4].tolist() == [0.0, 0.0, 0.0, 0.0]
    assert "not visible" in deformation.reason


def test_a_frame_from_before_the_arms_memory_is_not_used() -> None:
    estimator = Estimator()
    estimator.feed("history", PoseHistory(np.array([0.5, 0.6]), np.tile(Q_HOME, (2, 1))))
    estimator.feed("image", Image(1, 0.02, drawn(np.zeros(3))))
    assert estimator.at(0.05)[0].sample is None


def test_images_wait_for_an_arm_whose_poses_come_later() -> None:
    """Poses 0.1 s late, an image every 0.033 s: the newest image is always ahead of them, and the older ones are
    read."""
    estimator = Estimator()
    ages, read = [], []
    for k in range(1, 13):
        time = k / 30.0
        estimator.feed("image", Image(k, time - 0.04, drawn(np.zeros(3))))
        estimator.feed("history", PoseHistory(np.array([-1.0, time - 0.108, time - 0.1]), np.tile(Q_HOME, (3, 1))))
        deformation, vector = estimator.at(time + 0.001)
        ages.append(vector[4])
        read.append(deformation.sequence)
    assert read[4:] == list(range(3, 11)), "each, two images later"
    assert max(ages[4:]) < 0.12


def test_the_scenarios_camera_is_the_one_that_is_read() -> None:
    camera = scenario().finger_camera
    assert isinstance(camera, RenderedFingerCamera)
    assert camera.camera() == CAMERA
