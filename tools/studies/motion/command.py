"""Runs the commands on calibration in motion: what was asked for, as the options of the simulated world."""

from dataclasses import dataclass, replace
from pathlib import Path

from weldcal.models.errors import InputError
from weldcal.models.scanner_streams import get_stream
from weldcal.models.scanners import get_scanner
from weldcal.tools.console import Progress
from weldcal.tools.studies.motion.disturbance import Disturbance, Vector
from weldcal.tools.studies.motion.world import MotionOptions, MotionWorld, write_motion_dataset


@dataclass(frozen=True, kw_only=True)
class DataRequest:
    """A recording to be simulated, in the words of the command line: mm, ms and degrees; "" for what does not happen."""

    folder: Path
    seed: int = 0
    frames: int = 900
    robot: str = "ur5e"
    scanner: str = "motioncam_3d_stream"
    width: int | None = None
    move: str = "moveJ"
    speed: float = 0.25
    noise_mm: float | None = None
    readout_ms: float = 0.0
    stream_hz: float = 500.0
    poses: bool = False
    device_clock: bool = True
    surroundings: bool = True
    knock: str = ""
    creep: str = ""
    base: str = ""
    warm_up: str = ""

    def options(self) -> MotionOptions:
        """The simulated world's options. Raises InputError for a list of numbers that is none."""
        preset = get_scanner(self.scanner, self.width)
        return MotionOptions(
            robot=self.robot, scanner=self.scanner, size=(preset.width, preset.height) if self.width else None,
            frames=self.frames, move=self.move, speed=self.speed, noise_mm=self.noise_mm,
            stream=replace(get_stream(self.scanner), readout_s=1e-3 * self.readout_ms), stream_hz=self.stream_hz,
            stream_columns="pose" if self.poses else "joints", device_clock=self.device_clock,
            surroundings=self.surroundings, disturbance=self.disturbance(), seed=self.seed,
        )  # fmt: skip

    def disturbance(self) -> Disturbance:
        """What happens while the scanner streams."""
        knock, creep, base = (
            _numbers(text, name, counts)
            for text, name, counts in (
                (self.knock, "--knock", (4, 7)),
                (self.creep, "--creep", (4,)),
                (self.base, "--base", (4, 7)),
            )
        )
        warm_up = _numbers(self.warm_up, "--warm-up", (2, 3))
        return Disturbance(
            knock_s=knock[0], knock_mm=_vector(knock[1:4]), knock_deg=_vector(knock[4:7]),
            creep_s=creep[0], creep_mm_per_min=_vector(creep[1:4]),
            base_s=base[0], base_mm=_vector(base[1:4]), base_deg=_vector(base[4:7]),
            warm_up_s=warm_up[0], warm_up_scale=1e-6 * warm_up[1], warm_up_gradient_per_m=1e-6 * warm_up[2],
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


def write_motion_data(request: DataRequest, progress: Progress) -> dict[str, object]:
    """Write the recording to `dataset` and its truth to `truth.json` in the request's folder; returns where they are."""
    world = MotionWorld(request.options())
    folder = request.folder
    write_motion_dataset(world, folder / "dataset", folder / "truth.json", progress)
    return {
        "dataset": str(folder / "dataset"), "truth": str(folder / "truth.json"), "frames": len(world.captures),
        "seconds": round(float(world.captures[-1] - world.captures[0]), 3), "pixels": world.scanner.width * world.scanner.height,
    }  # fmt: skip
