"""Adds the drift watch of a weld job whose scanner streams: a queue, an estimator of its frames, and the DriftMonitor."""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import OutputPort

from weldcal.calibration.motion.drift.sequential import DriftConfig
from weldcal.models.flanges import FlangeStandard
from weldcal.systems.drivers.simulated.streaming.scanner import StreamingScanner
from weldcal.systems.jobs.weld.flange_estimator import FlangeEstimator
from weldcal.systems.jobs.weld.sequencer import JobSequencer
from weldcal.systems.messages import JobCommand
from weldcal.systems.motion.drift_monitor import DriftMonitor, MonitoredCalibration
from weldcal.systems.motion.frame_queue import FrameQueue
from weldcal.systems.motion.spine import Spine
from weldcal.systems.viewer.drift_view import DriftView
from weldcal.systems.wiring import Wiring

# between two stops a UR10e comes back to 0.05 mm (its data sheet), and a stop is no move of the scanner
WELD_DRIFT = DriftConfig(floor_m=5e-5, floor_rad=5e-5)
# a pose that the scenario states without its accuracy: only changes since the first frame are told
UNKNOWN = np.diag([0.02**2] * 3 + [0.01**2] * 3)


def add_watch(
    wiring: Wiring, spine: Spine, sequencer: JobSequencer, status: OutputPort, X_FR: RigidTransform, standard: FlangeStandard
) -> DriftMonitor | None:  # fmt: skip
    """Add the watch and connect it to the sequencer; None where the scanner does not stream, and nothing is added.

    The calibration that the job makes is watched from when it is done, one that the scenario states from the start.
    """
    scenario, station, c = wiring.scenario, wiring.station, wiring.scenario.calibration
    scanner, job = scenario.scanner, scenario.job
    if not isinstance(scanner, StreamingScanner):
        return None
    delay_s = scanner.stream().delay_s
    stated = None if job.calibrate or job.X_BC is None else job.X_BC.pose()
    watched = None if stated is None else MonitoredCalibration(stated, UNKNOWN, delay_s=delay_s, config=WELD_DRIFT)
    queue = wiring.add("frame_queue", FrameQueue())
    estimator = wiring.add(
        "streamed_flange_estimator",
        FlangeEstimator(
            arm=station.arm,
            X_FR=X_FR,
            standard=standard,
            X_BC_guess=stated or c.mounting_guess.pose(),
            guess_radius_m=c.guess_radius_mm * 1e-3,
            background=station.background,
            period_s=0.004,
            delay_s=delay_s,
        ),
    )
    monitor = wiring.add(
        "drift_monitor", DriftMonitor(station.arm, X_FR, watched, WELD_DRIFT, period_s=0.004, delay_s=delay_s)
    )
    estimate, drift = estimator.GetOutputPort("flange_estimate"), monitor.GetOutputPort("drift")
    wiring.connect(queue, stream=wiring.out("scanner.stream"), flange_estimate=estimate)
    wiring.connect(
        estimator, scan=queue.GetOutputPort("scan"), job=wiring.constant("no_ordered_scan", JobCommand()),
        history=spine.arm.history, calibration_status=status,
    )  # fmt: skip
    wiring.connect(monitor, flange_estimate=estimate, history=spine.arm.history, calibration_status=status)
    wiring.connect(sequencer, drift=drift)
    wiring.feed("scanner.streaming", sequencer.GetOutputPort("scanner_streaming"))
    if wiring.meshcat is not None:
        view = wiring.add("drift_view", DriftView(wiring.meshcat, 0.5 * standard.outer_m, scenario.visualization))
        wiring.connect(view, drift=drift, flange_estimate=estimate)
    return monitor
