"""Measure the soft tip's displacement from its rest position in the finger camera's images."""

import dataclasses as dc
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, State

from weldcal.models.arms.kinematics import ArmModel
from weldcal.models.tool import FingerCamera, WeldingTool
from weldcal.systems.background import Answer, Background, Inline, import_module
from weldcal.systems.leaf_system import LeafSystem
from weldcal.systems.messages import CalibrationStatus, Image, Message, believed_arm
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.welding.finger.deformation import TagModel, deflection_from_tag, detect_tag
from weldcal.welding.servo.state import DeflectionSample

IMAGES_KEPT = 10  # 1/3 s of images; after a longer gap the servo has stopped


@dc.dataclass(frozen=True, eq=False)
class Deformation(Message):
    """The newest deflection of the tip (p_T(tip) - p_T(rest), m, in T) and the pose at its time.

    None before the first. `covariance_T` (3,3) m^2 is of the deflection, None without a valid one.
    """

    sequence: int = 0
    sample: DeflectionSample | None = None
    reason: str = "no image yet"
    reprojection_px: float = np.nan
    covariance_T: np.ndarray | None = None


@dc.dataclass(frozen=True, eq=False)
class _Work(Message):
    """The last result, the newest image's number, and the images that wait for the arm's pose, oldest first."""

    found: Deformation = dc.field(default_factory=Deformation)
    newest_sequence: int = 0
    waiting: tuple[Image, ...] = ()
    asked: Answer[Deformation] | None = None


class ArucoDeformationEstimator(LeafSystem):
    """Detects the tag in each new image and pairs its displacement with the arm's pose at the image's capture time.

    .. pydrake_system::

        name: ArucoDeformationEstimator
        input_ports:
        - image
        - history
        - calibration_status
        output_ports:
        - deformation
        - deflection

    `deformation` carries a `Deformation`; `deflection` (5) is [tangential, normal, axial] in m, valid (1 or 0) and age
    s. A frame without a reliable tag is reported as invalid with its reason, not as an old value. Images wait for poses
    that arrive later than they do; if only the newest image were used, its pose would never be known. The tag is
    detected beside the control loop; a detection that takes longer than a frame skips the frames between. Poses are
    those of the arm with refined kinematics, where `calibration_status` (may stay open) has one.
    """

    def __init__(
        self,
        arm: ArmModel,
        tool: WeldingTool,
        camera: FingerCamera,
        background: Background | None = None,
        period_s: float = 0.008,
    ) -> None:
        super().__init__()
        self._background = background or Inline()
        self._background.prepare(import_module, __name__)
        self._arm, self._tool, self._K = arm, tool, camera.camera_matrix
        self._tag = TagModel(dictionary=tool.tag_dictionary, id=tool.tag_id, size_m=tool.tag_size_m)
        self._image = self.DeclareAbstractInputPort("image", AbstractValue.Make(Image()))
        self._history = self.DeclareAbstractInputPort("history", AbstractValue.Make(PoseHistory()))
        self._calibration = self.DeclareAbstractInputPort("calibration_status", AbstractValue.Make(CalibrationStatus()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(_Work()))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort("deformation", lambda: AbstractValue.Make(Deformation()), self._output, ticket)
        self.DeclareVectorOutputPort("deflection", 5, self._vector, ticket | {self.time_ticket()})
        self.DeclarePeriodicUnrestrictedUpdateEvent(period_s, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        old: _Work = context.get_abstract_state(self._state).get_value()
        work = old
        image: Image = self._image.Eval(context)
        if image.sequence > work.newest_sequence:
            waiting = (*work.waiting, image)[-IMAGES_KEPT:]
            work = dc.replace(work, newest_sequence=image.sequence, waiting=waiting)
        if work.asked is None and work.waiting:
            arm = believed_arm(self._calibration, context, self._arm)
            work = self._asked(work, self._history.Eval(context), arm)
        if work.asked is not None and work.asked.ready:
            work = dc.replace(work, found=work.asked.value, asked=None)
        if work is not old:
            state.get_mutable_abstract_state(self._state).set_value(work)

    def _asked(self, work: _Work, history: PoseHistory, arm: ArmModel) -> _Work:
        """Start the detection in the newest image with a known pose; older images are discarded."""
        for k in reversed(range(len(work.waiting))):
            image = work.waiting[k]
            X_BF = history.pose_at(arm, image.capture_time)
            if X_BF is not None:
                asked = self._background.ask(measure_deformation, image, X_BF, self._tool, self._tag, self._K)
                return dc.replace(work, waiting=work.waiting[k + 1 :], asked=asked)
        return work

    def _found(self, context: Context) -> Deformation:
        work: _Work = context.get_abstract_state(self._state).get_value()
        return work.found

    def _output(self, context: Context, output: Any) -> None:
        output.set_value(self._found(context))

    def _vector(self, context: Context, output: BasicVector) -> None:
        sample = self._found(context).sample
        if sample is None:
            output.SetFromVector([0.0, 0.0, 0.0, 0.0, np.inf])
            return
        age = context.get_time() - sample.capture_time
        output.SetFromVector([*sample.deflection_T, float(sample.valid), age])


def measure_deformation(
    image: Image, X_BF: RigidTransform, tool: WeldingTool, tag: TagModel, camera_matrix: np.ndarray
) -> Deformation:
    """Tag detection and rest-pose difference for one image (grey (H, W)).

    Invalid with a reason where the tag is not seen, or where the picture could be off by more than TagLimits.
    """
    seen = detect_tag(image.pixels, camera_matrix, tag)
    X_BT = X_BF @ tool.X_FT
    if not seen.valid or seen.X_KM is None or seen.covariance_K is None:
        sample = DeflectionSample(image.capture_time, X_BT, np.zeros(3), False)
        return Deformation(image.sequence, sample, seen.reason)
    R_TK = tool.X_FT.rotation().inverse() @ tool.X_FK.rotation()
    deflection = deflection_from_tag(seen.X_KM, tool.X_KM_rest, R_TK)
    sample = DeflectionSample(image.capture_time, X_BT, deflection, True)
    covariance = R_TK.matrix() @ seen.covariance_K @ R_TK.matrix().T
    return Deformation(image.sequence, sample, "", seen.reprojection_px, covariance)
