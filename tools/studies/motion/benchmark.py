"""`weldcal benchmark motion`: one command for the measurements of calibration in motion."""

from typing import Annotated

from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.studies.choice import run_chosen
from weldcal.tools.studies.motion.clock import benchmark_clock
from weldcal.tools.studies.motion.drift import benchmark_drift
from weldcal.tools.studies.motion.throughput import measure_throughput
from weldcal.tools.studies.motion.whole_body import benchmark_whole_body

PARTS = {
    "speed": measure_throughput,
    "clock": benchmark_clock.body,
    "drift": benchmark_drift.body,
    "whole-body": benchmark_whole_body.body,
}


@command("benchmark motion", short_help="Measure calibration in motion: speed, clock, drift.")
def benchmark_motion(
    call: Call,
    what: Annotated[str, option("--what", "NAME", "speed, clock, drift or whole-body.")] = "speed",
    seconds: Annotated[
        float | None, option("--seconds", "S", "speed, clock: length of a stream.", min=2.0, show_default="30, 20")
    ] = None,
    runs: Annotated[
        int | None, option("--runs", "N", "clock, drift: number of recordings.", min=2, show_default="300, 200")
    ] = None,
    creeps: Annotated[
        int | None, option("--creeps", "N", "drift: recordings with a creep.", min=1, show_default="8")
    ] = None,
    hours: Annotated[
        float | None, option("--hours", "H", "drift: hours in which nothing happens.", min=0.01, show_default="10")
    ] = None,
    stamps: Annotated[
        str | None, option("--stamps", "KIND", "drift: device or arrival.", show_default="device")
    ] = None,
    quick: Annotated[bool, switch("--quick", "drift: few recordings and minutes.")] = False,
    frames: Annotated[
        int | None, option("--frames", "N", "whole-body: frames of the recording.", min=12, show_default="200")
    ] = None,
    width: Annotated[
        int | None, option("--width", "PX", "whole-body: width of the image.", min=64, show_default="1068")
    ] = None,
    noise_mm: Annotated[
        float | None, option("--noise-mm", "MM", "whole-body: noise of one pixel.", show_default="the scanner's")
    ] = None,
    body: Annotated[
        str | None, option("--body", "LINK", "whole-body: the link that is tracked.", show_default="wrist_1_link")
    ] = None,
) -> Outcome:
    """Measure calibration in motion: the speed of fits beside an arm's control, the stated clock and pose, the drift test, or
    tracking by a link."""
    given = {
        "seconds": seconds, "runs": runs, "creeps": creeps, "hours": hours, "stamps": stamps, "quick": quick or None,
        "frames": frames, "width": width, "noise_mm": noise_mm, "body": body,
    }  # fmt: skip
    return run_chosen(call, what, PARTS, given)
