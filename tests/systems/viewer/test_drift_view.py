"""DriftView: the board shows the newest error, offset and statistic, and a new one replaces the old one."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform

from weldcal.calibration.flange.fit import FlangeFit
from weldcal.systems.messages import FlangeEstimate
from weldcal.systems.motion.drift_monitor import DriftStatus
from weldcal.systems.scenario.schema import VisualizationConfig
from weldcal.systems.viewer.drift_view import ROOT, DriftView, drift_picture


def status(frames: int, jump: float = 0.0) -> DriftStatus:
    t = 0.05 * np.arange(frames)
    recent = np.zeros((frames, 6))
    recent[:, 0], recent[:, 5] = t, 5.0
    recent[frames // 2 :, 1] = jump
    return DriftStatus(frames=frames, recent=recent, threshold=60.0, alarmed=jump > 0.0, X_BC=RigidTransform())


def test_a_jump_of_the_error_is_a_step_of_its_curve() -> None:
    calm, moved = drift_picture(status(40)), drift_picture(status(40, 1e-3))
    red = [(p[45:165, :, 2] > 180) & (p[45:165, :, 0] < 140) for p in (calm, moved)]
    late = slice(600, 980)
    assert np.argwhere(red[0][:, late])[:, 0].size == 0  # under the curve of z, which is drawn last
    assert np.argwhere(red[1][:, late])[:, 0].mean() < 30
    assert not np.array_equal(calm[410:445], moved[410:445])


def test_an_empty_watch_is_a_board() -> None:
    assert drift_picture(DriftStatus()).shape == (600, 1024, 3)


def test_boards_follow_each_other_and_the_scanner_stands_where_it_is_believed() -> None:
    meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
    view = DriftView(meshcat, 0.03, VisualizationConfig(), period_s=0.1)
    context = view.CreateDefaultContext()
    drift = view.GetInputPort("drift").FixValue(context, AbstractValue.Make(status(30)))
    fit = FlangeFit(np.ones(3), np.array([0.0, 0.0, -1.0]), np.eye(3), 1e-3, 1e-4, 1e-4, 0.03, None, 1000, 100, 1.0)
    view.GetInputPort("flange_estimate").FixValue(context, AbstractValue.Make(FlangeEstimate(1, 0.0, fit=fit)))
    view._draw(context)
    context.SetTime(0.2)
    view._draw(context)  # nothing is new
    assert not meshcat.HasPath(f"{ROOT}/board/0001")
    drift.GetMutableData().set_value(status(31))
    view._draw(context)
    assert all(meshcat.HasPath(f"{ROOT}/{name}") for name in ("board/0000", "board/0001", "scanner/axis0", "ring"))
