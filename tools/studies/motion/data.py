"""`weldcal reproduce motion-data`: a simulated recording in motion, with its truth beside it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from weldcal.models.errors import InputError
from weldcal.models.scanner_streams import get_stream
from weldcal.models.scanners import get_scanner
from weldcal.tools.cli.options import Call, command, option, switch
from weldcal.tools.console import Progress
from weldcal.tools.worlds.disturbance import Disturbance, Vector
from weldcal.tools.worlds.motion import MotionOptions, MotionWorld, write_motion_dataset


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
    folder = call.folder("reproduce", "motion-data")
    preset = get_scanner(scanner, width)
    options = MotionOptions(
        robot=robot, scanner=scanner, size=(preset.width, preset.height) if width else None, frames=frames, move=move,
        speed=speed, noise_mm=noise_mm, stream=replace(get_stream(scanner), readout_s=1e-3 * readout_ms),
        stream_hz=stream_hz, stream_columns="pose" if poses else "joints", device_clock=device_clock,
        surroundings=surroundings, disturbance=disturbance_of(knock, creep, base, warm_up), seed=call.seed,
    )  # fmt: skip
    return write_motion_data(options, folder, call.progress)


def disturbance_of(knock: str = "", creep: str = "", base: str = "", warm_up: str = "") -> Disturbance:
    """What happens while the scanner streams, from the numbers of the command line; "" for nothing.

    Raises:
        InputError: a text is no such list of numbers.
    """
    knocked = _numbers(knock, "--knock", (4, 7))
    creeping = _numbers(creep, "--creep", (4,))
    based = _numbers(base, "--base", (4, 7))
    warming = _numbers(warm_up, "--warm-up", (2, 3))
    return Disturbance(
        knock_s=knocked[0], knock_mm=_vector(knocked[1:4]), knock_deg=_vector(knocked[4:7]),
        creep_s=creeping[0], creep_mm_per_min=_vector(creeping[1:4]),
        base_s=based[0], base_mm=_vector(based[1:4]), base_deg=_vector(based[4:7]),
        warm_up_s=warming[0], warm_up_scale=1e-6 * warming[1], warm_up_gradient_per_m=1e-6 * warming[2],
    )  # fmt: skip


def _numbers(text: str, name: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Seven numbers, zeros behind those given."""
    try:
        given = tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        given = (float("nan"),)
    if text and (len(given) not in counts or not all(abs(v) < 1e6 for v in given)):
        raise InputError(f"{name} takes {' or '.join(map(str, counts))} numbers with commas between, and is '{text}'.")
    return given + (0.0,) * (7 - len(given))


def _vector(values: tuple[float, ...]) -> Vector:
    return values[0], values[1], values[2]


def write_motion_data(options: MotionOptions, folder: Path, progress: Progress) -> dict[str, object]:
    """Write the recording to `dataset` and its truth to `truth.json` in the folder; returns where they are."""
    world = MotionWorld(options)
    write_motion_dataset(world, folder / "dataset", folder / "truth.json", progress)
    return {
        "dataset": str(folder / "dataset"), "truth": str(folder / "truth.json"), "frames": len(world.captures),
        "seconds": round(float(world.captures[-1] - world.captures[0]), 3), "pixels": world.scanner.width * world.scanner.height,
    }  # fmt: skip
