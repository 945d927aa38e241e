"""weldcal reproduce motion, reproduce motion-data and benchmark motion: calibration in motion, simulated."""

from collections.abc import Mapping
from typing import Annotated

from weldcal.tools.cli.options import Call, Outcome, command, option, switch


@command("reproduce motion-data", short_help="Write a simulated recording in motion with its truth.")
def motion_data(
    call: Call,
    frames: Annotated[int, option("--frames", "N", "Frames that the scanner captures.", min=1)] = 900,
    robot: Annotated[str, option("--arm", "NAME", "A UR arm.")] = "ur5e",
    scanner: Annotated[str, option("--scanner", "NAME", "A streaming scanner.")] = "motioncam_3d_stream",
    width: Annotated[
        int | None, option("--width", "PX", "Resize the scanner's image.", min=64, show_default="its own")
    ] = None,
    move: Annotated[str, option("--move", "NAME", "moveJ or moveL.")] = "moveJ",
    speed: Annotated[float, option("--speed", "M/S", "Largest speed of the flange.", min=0.001)] = 0.25,
    noise_mm: Annotated[
        float | None, option("--noise-mm", "MM", "Noise of one pixel at the best distance.", show_default="its own")
    ] = None,
    readout_ms: Annotated[float, option("--readout-ms", "MS", "From the first to the last row.", min=0.0)] = 0.0,
    stream_hz: Annotated[float, option("--stream-hz", "HZ", "Rate of the robot's stream.")] = 500.0,
    poses: Annotated[bool, switch("--poses", "Write flange poses to the stream, not joint angles.")] = False,
    device_clock: Annotated[
        bool, switch("--device-clock/--no-device-clock", "With the device's stamps, or arrivals only.")
    ] = True,
    surroundings: Annotated[
        bool, switch("--surroundings/--no-surroundings", "Show the table and blocks on it too.")
    ] = True,
    knock: Annotated[
        str, option("--knock", "T,X,Y,Z[,R,P,Y]", "The scanner jumps: s, mm, degrees.", show_default="none")
    ] = "",
    creep: Annotated[
        str, option("--creep", "T,X,Y,Z", "The scanner creeps from then on: s, mm/min.", show_default="none")
    ] = "",
    base: Annotated[
        str, option("--base", "T,X,Y,Z[,R,P,Y]", "The robot's base jumps: s, mm, degrees.", show_default="none")
    ] = "",
    warm_up: Annotated[
        str,
        option("--warm-up", "TAU,PPM[,PPM/M]", "The scanner's scale error dies away: s, ppm.", show_default="none"),
    ] = "",
) -> Mapping[str, object]:
    """Write a simulated recording in motion: a UR arm moves through a cube's corners, seen by a streaming scanner.

    The recording is the folder 'dataset', the truth of pose and clock the file truth.json beside it.
    """
    from weldcal.tools.studies.motion.command import DataRequest, write_motion_data

    request = DataRequest(
        folder=call.folder("reproduce", "motion-data"),
        seed=call.seed,
        frames=frames,
        robot=robot,
        scanner=scanner,
        width=width,
        move=move,
        speed=speed,
        noise_mm=noise_mm,
        readout_ms=readout_ms,
        stream_hz=stream_hz,
        poses=poses,
        device_clock=device_clock,
        surroundings=surroundings,
        knock=knock,
        creep=creep,
        base=base,
        warm_up=warm_up,
    )
    return write_motion_data(request, call.progress)


@command("reproduce motion", short_help="Repeat the paper on calibration in motion.")
def motion(
    call: Call,
    quick: Annotated[bool, switch("--quick", "A seventh of the pixels and 90 frames; decides nothing.")] = False,
    frames: Annotated[int | None, option("--frames", "N", "Frames in motion.", min=40, show_default="600")] = None,
) -> Outcome:
    """Repeat the flange paper on motion: Table 1, Eq. 21, Fig. 5, 6 and 9; the recording and its truth are kept. 15 min."""
    from functools import partial

    from weldcal.tools.studies.motion.reproduce import run_motion_study
    from weldcal.tools.studies.motion.results import MotionStudyOptions
    from weldcal.tools.studies.targets import print_targets

    options = MotionStudyOptions(call.folder("reproduce", "motion"), call.seed, quick, frames)
    study = run_motion_study(options, call.progress)
    text = partial(print_targets, "calibration in motion", study.targets)
    missed = "" if study.met else "Some targets were missed; see the table."
    return Outcome(study.summary(), {}, {}, text, problem=missed)


@command("benchmark motion", short_help="Measure frames per second beside an arm's control.")
def throughput(
    call: Call, seconds: Annotated[float, option("--seconds", "S", "Length of the stream.", min=2.0)] = 30.0
) -> Outcome:
    """Fit half-megapixel frames at 20 per second beside an arm's control: frames per second, and arrival to estimate."""
    from functools import partial

    from weldcal.tools.studies.motion.throughput import run_throughput
    from weldcal.tools.studies.targets import print_targets

    found = run_throughput(call.folder("benchmark", "motion"), seconds, call.seed, call.progress)
    return Outcome(found.summary(), text=partial(print_targets, "streamed scans", found.targets))
