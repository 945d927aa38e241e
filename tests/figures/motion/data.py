"""`./tools/run figures reproduce motion-data`: a simulated recording in motion, with its truth beside it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

from tests.worlds.motion import MotionOptions, MotionWorld, disturbance_of, write_motion_dataset
from weldcal.models.scanner_streams import get_stream
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.options import Call, command, option, switch


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
        str, option("--warm-up", "TAU,PPM[,PPM/M]", "The scanner's scale error dies away: s, ppm.", show_default="none")
    ] = "",
) -> Mapping[str, object]:
    """Write a simulated recording in motion: a UR arm moves through a cube's corners before a streaming scanner.

    The recording is the folder 'dataset', the truth of pose and clock the file truth.json beside it.
    """
    folder = call.folder("reproduce", "motion-data")
    preset = get_scanner(scanner, width)
    options = MotionOptions(
        robot=robot,
        scanner=scanner,
        size=(preset.width, preset.height) if width else None,
        frames=frames,
        move=move,
        speed=speed,
        noise_mm=noise_mm,
        stream=replace(get_stream(scanner), readout_s=1e-3 * readout_ms),
        stream_hz=stream_hz,
        stream_columns="pose" if poses else "joints",
        device_clock=device_clock,
        surroundings=surroundings,
        disturbance=disturbance_of(knock, creep, base, warm_up),
        seed=call.seed,
    )
    world = MotionWorld(options)
    write_motion_dataset(world, folder / "dataset", folder / "truth.json", call.progress)
    return {
        "dataset": str(folder / "dataset"),
        "truth": str(folder / "truth.json"),
        "frames": len(world.captures),
        "seconds": round(float(world.captures[-1] - world.captures[0]), 3),
        "pixels": world.scanner.width * world.scanner.height,
    }
