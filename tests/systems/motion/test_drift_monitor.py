"""DriftMonitor: a knock raises `moved`, is measured, and the recalibrated pose is the new one; all state is in the
Context. The scanner's clock is learnt where the calibration's is of another run."""

import dataclasses as dc

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.calibration.data.scanner_correction import ARRIVAL, DEVICE, ScannerClock
from weldcal.calibration.flange.fit import FlangeFit
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.arrays import Array
from weldcal.systems.messages import FlangeEstimate
from weldcal.systems.motion.buffers import PoseHistory
from weldcal.systems.motion.drift_monitor import DriftMonitor, DriftStatus, MonitoredCalibration

ARM = load_arm("ur10e")
X_BC = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [-0.6, -0.2, 1.1])
SHIFT = np.array([0.3e-3, 0.0, -0.4e-3])
DELAY_S, KNOCK_S = 0.14, 8.0
SIGMA_M, SIGMA_RAD = 3e-5, 4e-4


def joints(t: Array) -> Array:
    """Joint angles (n, 6) of a slow dance near one pose."""
    base = np.array([0.3, -1.6, 2.0, -2.0, -1.5, 0.3])
    wave = np.column_stack([np.sin((0.7 + 0.2 * k) * t + k) for k in range(6)])
    return base + 0.08 * wave


def estimate(
    k: int, t: float, rng: np.random.Generator, *, seen: bool = True, knock_s: float = KNOCK_S
) -> FlangeEstimate:
    """Estimate k of a frame captured at ``t`` s, after the knock from a scanner that stands elsewhere."""
    X = RigidTransform(X_BC.rotation(), X_BC.translation() + SHIFT * (t > knock_s))
    X_CR = X.InvertAndCompose(forward_kinematics(ARM, joints(np.array([t]))[0]))
    n = X_CR.rotation().matrix()[:, 2] + SIGMA_RAD * rng.standard_normal(3)
    center = X_CR.translation() + SIGMA_M * rng.standard_normal(3)
    fit = FlangeFit(
        center_C=center,
        normal_C=n / np.linalg.norm(n),
        center_covariance=SIGMA_M**2 * np.eye(3),
        normal_sigma=SIGMA_RAD,
        plane_rms_m=1e-4,
        rim_rms_m=1e-4,
        outer_radius_m=0.0315,
        bore_radius_m=None,
        n_points=1000,
        coverage=1.0,
    )
    return FlangeEstimate(
        sequence=k, capture_time=t, purpose="stream", fit=fit if seen else None, arrival_time=t + DELAY_S
    )


@pytest.fixture(scope="module")
def run() -> tuple[list[DriftStatus], list[float], DriftStatus]:
    """The status after each frame, the port `moved`, and the status after a recalibration at the end."""
    rng = np.random.default_rng(1)
    watched = MonitoredCalibration(X_BC, np.diag([1e-9] * 6), delay_s=DELAY_S)
    monitor = DriftMonitor(ARM, RigidTransform(), watched)
    context = monitor.CreateDefaultContext()
    times = np.arange(0.0, 16.0, 0.008)
    history = PoseHistory(times, joints(times))
    monitor.GetInputPort("history").FixValue(context, AbstractValue.Make(history))
    monitor.GetInputPort("recalibrate").FixValue(context, [0.0])
    port = monitor.GetInputPort("flange_estimate").FixValue(context, AbstractValue.Make(FlangeEstimate()))
    found, moved = [], []

    def tick() -> None:
        monitor._update(context, context.get_mutable_state())

    for k, t in enumerate(np.arange(0.3, 14.0, 0.05)):
        port.GetMutableData().set_value(estimate(k + 1, float(t), rng, seen=k != 30))
        tick()
        found.append(monitor.GetOutputPort("drift").Eval(context))
        moved.append(float(monitor.GetOutputPort("moved").Eval(context)[0]))
    monitor.GetInputPort("recalibrate").FixValue(context, [1.0])
    tick()
    return found, moved, monitor.GetOutputPort("drift").Eval(context)


def test_moved_rises_after_the_knock_and_stays(run: tuple[list[DriftStatus], list[float], DriftStatus]) -> None:
    _, moved, _ = run
    times = np.arange(0.3, 14.0, 0.05)
    first = float(times[moved.index(1.0)])
    assert KNOCK_S < first < KNOCK_S + 2.0
    assert all(moved[moved.index(1.0) :])


def test_the_move_is_measured(run: tuple[list[DriftStatus], list[float], DriftStatus]) -> None:
    found, _, _ = run
    (e,) = found[-1].events
    assert e.translation_m == pytest.approx(SHIFT, abs=5e-5)
    assert abs(e.time_s - KNOCK_S) < 0.25
    assert "0.5" in found[-1].summary
    assert found[-1].frames == len(found) - 1
    assert found[-1].dropped == 1
    assert np.isfinite(found[-1].recent).all()


def test_an_earlier_status_does_not_change(run: tuple[list[DriftStatus], list[float], DriftStatus]) -> None:
    found, _, _ = run
    assert not found[100].moved
    assert found[100].events == ()
    assert found[100].summary == ""


def test_a_recalibration_takes_the_new_pose(run: tuple[list[DriftStatus], list[float], DriftStatus]) -> None:
    _, _, after = run
    assert after.recalibrations == 1
    assert not after.moved
    assert after.X_BC is not None
    assert after.X_BC.translation() - X_BC.translation() == pytest.approx(SHIFT, abs=8e-5)


def watched(clock: ScannerClock | None, at_0_s: float, late_s: Array) -> DriftStatus:
    """The status at 14 s of a scanner whose clock reads `at_0_s` at 0, and whose frames came `late_s` (n,) later than
    usual."""
    rng = np.random.default_rng(2)
    calibration = MonitoredCalibration(X_BC, np.diag([1e-9] * 6), clock=clock, delay_s=DELAY_S)
    monitor = DriftMonitor(ARM, RigidTransform(), calibration)
    context = monitor.CreateDefaultContext()
    state = context.get_mutable_state()
    for k, t in enumerate(np.arange(0.5, 14.0, 0.1)):
        late = late_s[k % len(late_s)]
        arrival = float(t) + DELAY_S + late
        times = np.arange(max(0.0, arrival - 10.0), arrival, 0.008)
        monitor.GetInputPort("history").FixValue(context, AbstractValue.Make(PoseHistory(times, joints(times))))
        seen = dc.replace(estimate(k + 1, float(t), rng), arrival_time=arrival, device_time=at_0_s + float(t))
        monitor.GetInputPort("flange_estimate").FixValue(context, AbstractValue.Make(seen))
        monitor._update(context, state)
    return monitor.status(context)


@pytest.mark.parametrize(
    "late_s",
    [
        [0.15, 0.0, 0.01, 0.05],
        [0.0, 0.02, 0.2, 0.01, 0.03],
        [0.42, 0.0, 0.02, 0.01],
        [0.9, 0.7, 0.4, 0.2, 0.0, 0.02, 0.01],
    ],
    ids=["first late", "others late", "first very late", "a queue at first"],
)
@pytest.mark.parametrize(
    "clock",
    [
        None,
        ScannerClock(kind=DEVICE, offset_s=-1000.12, sigma_s=1e-4, jitter_s=3e-4, reference_s=1000.0),
        ScannerClock(kind=DEVICE, offset_s=55.0, sigma_s=1e-4, jitter_s=3e-4, reference_s=1000.0),
        ScannerClock(kind=DEVICE, offset_s=-1000.0, sigma_s=1e-4, jitter_s=3e-4, reference_s=1000.0),
        ScannerClock(kind=ARRIVAL, offset_s=DELAY_S + 0.02, sigma_s=1e-2, jitter_s=0.015, reference_s=0.0),
    ],
    ids=["unknown", "another start", "another day", "this run", "arrivals"],
)
def test_one_knock_is_found_whatever_the_calibration_says_of_the_clock(
    clock: ScannerClock | None, late_s: list[float]
) -> None:
    """The scanner's clock reads 1000 s at 0; the calibration's offset is that of the start of its own run."""
    status = watched(clock, 1000.0, np.array(late_s))
    assert len(status.events) == 1
    event = status.events[0]
    assert abs(event.time_s - KNOCK_S) < 0.3
    assert event.found_s - KNOCK_S < 2.0
    assert event.translation_m == pytest.approx(SHIFT, abs=1e-4)
    assert status.dropped == 0


@pytest.mark.parametrize(("set_by_s", "lost"), [(-70.0, 0), (1.2, 0), (-1.2, 62)], ids=["anew", "forward", "back"])
def test_a_clock_that_is_set_is_learnt_again(set_by_s: float, lost: int) -> None:
    """Nothing moves: what the second half shows is another device clock.

    One that was set back a little may be late for 3 s.
    """
    calibration = MonitoredCalibration(X_BC, np.diag([1e-9] * 6), delay_s=DELAY_S)
    monitor = DriftMonitor(ARM, RigidTransform(), calibration)
    context, rng = monitor.CreateDefaultContext(), np.random.default_rng(3)
    times = np.arange(0.0, 11.0, 0.008)
    monitor.GetInputPort("history").FixValue(context, AbstractValue.Make(PoseHistory(times, joints(times))))
    frames = np.arange(0.5, 9.5, 0.05)
    for k, t in enumerate(frames):
        device = 70.0 + float(t) + (set_by_s if t > 4.0 else 0.0)
        arrival = float(t) + DELAY_S + 0.1 * (k % 7 == 0)
        seen = estimate(k + 1, float(t), rng, knock_s=np.inf)
        seen = dc.replace(seen, arrival_time=arrival, device_time=device)
        monitor.GetInputPort("flange_estimate").FixValue(context, AbstractValue.Make(seen))
        monitor._update(context, context.get_mutable_state())
    status = monitor.status(context)
    assert status.events == ()
    assert not status.moved
    assert status.dropped <= lost
    assert status.frames + status.dropped == len(frames)
