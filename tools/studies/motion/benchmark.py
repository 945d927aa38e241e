"""`weldcal benchmark motion`: one command for the measurements of calibration in motion."""

from weldcal.tools.cli.options import FARM, Call, command
from weldcal.tools.cli.subject import one_of
from weldcal.tools.studies.motion.clock import benchmark_clock
from weldcal.tools.studies.motion.drift import benchmark_drift
from weldcal.tools.studies.motion.throughput import benchmark_speed
from weldcal.tools.studies.motion.whole_body import benchmark_whole_body


@command("benchmark motion", short_help="Measure calibration in motion: speed, clock, drift.", options=FARM)
@one_of("speed", speed=benchmark_speed, clock=benchmark_clock, drift=benchmark_drift, whole_body=benchmark_whole_body)
def benchmark_motion(call: Call) -> None:
    """Measure calibration in motion: the speed of fits beside an arm's control, the stated clock and pose, the drift
    test, or tracking by a link."""
