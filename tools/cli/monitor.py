"""weldcal benchmark drift and benchmark whole-body: the watch of a calibration, measured in simulation."""

from typing import Annotated

from weldcal.tools.cli.options import Call, Outcome, command, option, switch


@command("benchmark drift", short_help="Measure how soon a moved scanner is found.")
def benchmark_drift(
    call: Call,
    runs: Annotated[int, option("--runs", "N", "Recordings with a knock: every other one shifts, turns.", min=2)] = 200,
    creeps: Annotated[int, option("--creeps", "N", "Recordings with a creep.", min=1)] = 8,
    hours: Annotated[float, option("--hours", "H", "Simulated hours in which nothing happens.", min=0.01)] = 10.0,
    stamps: Annotated[str, option("--stamps", "KIND", "device (0.1 ms) or arrival (15 ms, skewed).")] = "device",
    quick: Annotated[bool, switch("--quick", "Few recordings and minutes: seconds instead of an hour.")] = False,
) -> Outcome:
    """Measure the drift test: how soon knocks of 0.2 mm or 0.03 degrees and creeps are found, and false alarms."""
    from weldcal.models.errors import InputError
    from weldcal.tools.studies.motion.drift import Size, run_drift_study
    from weldcal.tools.studies.targets import print_targets

    if stamps not in ("device", "arrival"):
        raise InputError(f"Stamps are 'device' or 'arrival', not '{stamps}'.")
    size = Size(2, 1, 0.01) if quick else Size(runs, creeps, hours)
    result, targets = run_drift_study(
        call.folder("benchmark", "drift"), size, stamps=stamps, seed=call.seed, progress=call.progress
    )
    return Outcome(result, text=lambda: print_targets("Drift", targets))


@command("benchmark whole-body", short_help="Compare tracking by the flange with tracking by a link.")
def benchmark_whole_body(
    call: Call,
    frames: Annotated[int, option("--frames", "N", "Frames of the recording.", min=12)] = 200,
    width: Annotated[int, option("--width", "PX", "Width of the scanner's image.", min=64)] = 1068,
    noise_mm: Annotated[
        float | None, option("--noise-mm", "MM", "Noise of one pixel.", show_default="the scanner's")
    ] = None,
    body: Annotated[str, option("--body", "LINK", "The link that is tracked.")] = "wrist_1_link",
) -> Outcome:
    """Compare the tracking error of the flange with that of a link, by its mesh and by a model fused from the scans."""
    from weldcal.tools.studies.motion.whole_body import run_whole_body
    from weldcal.tools.studies.motion.world import MotionOptions
    from weldcal.tools.studies.targets import print_targets

    options = MotionOptions(
        frames=frames, size=(width, round(0.749 * width)), noise_mm=noise_mm, seed=call.seed, surroundings=False
    )
    summary, targets = run_whole_body(call.folder("benchmark", "whole-body"), options, body, call.progress)
    return Outcome(summary, text=lambda: print_targets("Whole body", targets))
