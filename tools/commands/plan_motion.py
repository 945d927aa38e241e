"""`weldcal plan-motion`: which motion tells most of the scanner's pose and clock, before anything is recorded."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydrake.math import RigidTransform

from weldcal.calibration.data.motion_dataset import read_stream
from weldcal.calibration.data.results import load_result
from weldcal.calibration.motion.expected import PredictedSigma, closed_moves, expected_of_motion, recorded_stream
from weldcal.calibration.motion.stream import ContinuousMotion
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.models.result_files import write_atomic
from weldcal.systems.jobs.motion.job import MotionJob, plan_corners
from weldcal.systems.runner import Progress
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.systems.station import make_station
from weldcal.tools.cli.options import Call, Outcome, command, option, switch
from weldcal.tools.report.files import write_json

_EDGES, _LEANS = (0.5, 1.0, 1.25), (5.0, 15.0, 25.0)  # of the scenario's cube; degrees
_SPEED_M_S = 0.25  # of a part to be scanned: what an error of the clock costs


@command("plan-motion", short_help="Find the best motion for a calibration in motion.")
def plan_motion(
    call: Call,
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="Arm, scanner's guess and cube: a scenario by name or YAML file.")
    ] = "motion",
    stream: Annotated[
        list[Path] | None,
        option("--stream", "FILE", "Compare recorded programs, tables as stream.csv, instead of cubes; may repeat."),
    ] = None,
    calibration: Annotated[
        Path | None, option("--calibration", "RESULT", "Where the scanner stands.", show_default="the scenario's guess")
    ] = None,
    seconds: Annotated[float, option("--seconds", "S", "How long the scanner streams.", min=2.0)] = 20.0,
    device_clock: Annotated[
        bool, switch("--device-clock/--no-device-clock", "Frames with the device's times, or arrivals only.")
    ] = True,
) -> Outcome:
    """Predict what motions tell of the scanner's pose and clock, and write the best one as URScript. Nothing moves.

    The error is that of a point among the flange's places, one sigma, of noise alone.
    """

    found = plan_motions(
        scenario,
        call.folder("plan-motion", scenario),
        streams=stream or (),
        calibration=calibration,
        seconds=seconds,
        device=device_clock,
        seed=call.seed,
        progress=call.progress,
    )
    rows = {str(p["name"]): _line(p) for p in found["motions"]}  # type: ignore[attr-defined]
    return Outcome(found, values={"written to": found["written_to"]}, rows=rows)


def _line(p: dict[str, float | None]) -> str:
    shown = (("error_mm", "mm", 3), ("rotation_deg", "deg", 4), ("clock_offset_ms", "ms", 3))
    return ", ".join("open" if p[k] is None else f"{p[k]:.{digits}f} {unit}" for k, unit, digits in shown)


@dataclass(frozen=True, kw_only=True)
class Planned:
    """A motion and what it is expected to tell, one sigma; infinite where it shows nothing. ``cost_mm`` is the error of
    a point on a part in motion. ``corners_deg`` are the joint angles of a cube's corners, empty for a stream."""

    name: str
    error_mm: float
    rotation_deg: float
    clock_offset_ms: float
    shared: float
    cost_mm: float
    corners_deg: tuple[tuple[float, ...], ...] = ()


def plan_motions(
    scenario: str,
    out: Path,
    *,
    streams: Sequence[Path] = (),
    calibration: Path | None = None,
    seconds: float = 20.0,
    device: bool = True,
    seed: int = 0,
    progress: Progress = lambda stage, fraction: None,
) -> dict[str, object]:
    """Compare motions and write plan.json, and best.script with the moves of the best cube, to ``out``.

    The motions are ``streams``, tables as stream.csv that the robot's program has written without a scanner; without
    any, cubes about the scenario's centre, of several sizes and leans, whose moves are free. ``calibration`` tells
    where the scanner stands, else the scenario's guess. ``seconds`` is how long the scanner streams, ``device`` whether
    its frames have device times. Raises InputError: no motion can be planned, or a file cannot be read.
    """
    loaded = load_scenario(scenario)
    X_BC = loaded.calibration.mounting_guess.pose() if calibration is None else load_result(calibration).X_BC
    jitter_s = 1e-4 if device else 0.015
    found = [_of_stream(path, loaded.arm, X_BC, jitter_s) for path in streams]
    if not streams:
        found = _of_cubes(loaded, X_BC, seconds, jitter_s, seed, progress)
    found.sort(key=lambda p: p.cost_mm)
    best = found[0]
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, object] = {
        "state": "done",
        "best": _plain(best),
        "motions": [_plain(p) for p in found],
        "device_times": device,
        "seconds": None if streams else seconds,
    }
    write_json(out / "plan.json", result)
    if best.corners_deg:
        speed = (loaded.part(MotionJob) or MotionJob()).speed_m_s
        write_atomic(out / "best.script", _script(best, speed))
    return result | {"written_to": str(out)}


def _of_stream(path: Path, arm: str, X_BC: RigidTransform, jitter_s: float) -> Planned:
    stream, _ = read_stream(path, robot=arm)
    return _planned(str(path), expected_of_motion(ContinuousMotion(stream), X_BC, jitter_s=jitter_s))


def _of_cubes(
    scenario: Scenario, X_BC: RigidTransform, seconds: float, jitter_s: float, seed: int, progress: Progress
) -> list[Planned]:
    """Cubes of several sizes and leans about the scenario's centre that the arm can move through."""
    job = scenario.part(MotionJob) or MotionJob()
    station = make_station(scenario, seed)
    found: list[Planned] = []
    reason = ""
    tried = [(edge, lean) for edge in _EDGES for lean in _LEANS]
    try:
        for k, (share, lean) in enumerate(tried):
            progress("motions", k / len(tried))
            cube = replace(job, edge_mm=share * job.edge_mm, lean_deg=lean)
            rng = np.random.default_rng([seed, 16, k])
            try:
                corners = plan_corners(scenario, station, cube, np.deg2rad(scenario.home_deg), rng)
            except InputError as error:
                reason = reason or str(error)
                continue
            moves = replace(closed_moves(np.array(corners), linear=False), speed=job.speed_m_s)
            stream = recorded_stream(moves, seconds, rng, jitter_s=0.0, joints=True)
            told = expected_of_motion(ContinuousMotion(stream), X_BC, jitter_s=jitter_s)
            angles = tuple(tuple(round(float(v), 3) for v in np.degrees(q)) for q in corners)
            found.append(_planned(f"cube of {cube.edge_mm:.0f} mm, lean of {lean:.0f} deg", told, angles))
    finally:
        station.close()
    if not found:
        raise InputError(reason)
    return found


def _planned(name: str, told: PredictedSigma, corners: tuple[tuple[float, ...], ...] = ()) -> Planned:
    cost = float(np.hypot(told.work_m, _SPEED_M_S * told.offset_s))
    return Planned(
        name=name,
        error_mm=1e3 * told.work_m,
        rotation_deg=float(np.degrees(told.turn_rad)),
        clock_offset_ms=1e3 * told.offset_s,
        shared=told.shared,
        cost_mm=1e3 * cost,
        corners_deg=corners,
    )


def _plain(planned: Planned) -> dict[str, object]:
    """As plain values; what a motion does not show is None."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in asdict(planned).items()}


def _script(planned: Planned, speed_m_s: float) -> str:
    """URScript of the moves, to be repeated while the scanner streams."""
    radians: list[Array] = [np.radians(q) for q in planned.corners_deg]
    lines = [
        f"# {planned.name}: repeat while the scanner streams. Lower v until the flange moves at {speed_m_s:g} m/s."
    ]
    lines += [f"movej([{', '.join(f'{v:.6f}' for v in q)}], a=1.2, v=0.4)" for q in radians]
    return "\n".join(lines) + "\n"
