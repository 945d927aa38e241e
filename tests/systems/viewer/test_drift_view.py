"""DriftView: the scanner stands where it is believed, and the ring where it was seen."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform

from weldcal.calibration.flange.fit import FlangeFit
from weldcal.systems.messages import FlangeEstimate
from weldcal.systems.motion.drift_monitor import DriftStatus
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.drift_view import ROOT, DriftView


def status(frames: int, jump: float = 0.0) -> DriftStatus:
    t = 0.05 * np.arange(frames)
    recent = np.zeros((frames, 6))
    recent[:, 0], recent[:, 5] = t, 5.0
    recent[frames // 2 :, 1] = jump
    return DriftStatus(frames=frames, recent=recent, threshold=60.0, alarmed=jump > 0.0, X_BC=RigidTransform())


def test_scanner_and_ring_are_drawn_where_they_are_believed() -> None:
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    view = DriftView(meshcat, 0.03, VisualizationConfig(), period_s=0.1)
    context = view.CreateDefaultContext()
    view.GetInputPort("drift").FixValue(context, AbstractValue.Make(status(30)))
    fit = FlangeFit(
        center_C=np.ones(3),
        normal_C=np.array([0.0, 0.0, -1.0]),
        center_covariance=np.eye(3),
        normal_sigma=1e-3,
        plane_rms_m=1e-4,
        rim_rms_m=1e-4,
        outer_radius_m=0.03,
        bore_radius_m=None,
        n_points=1000,
        coverage=1.0,
    )
    view.GetInputPort("flange_estimate").FixValue(
        context, AbstractValue.Make(FlangeEstimate(sequence=1, capture_time=0.0, fit=fit))
    )
    view._draw(context)
    assert all(meshcat.HasPath(f"{ROOT}/{name}") for name in ("scanner/axis0", "ring"))
