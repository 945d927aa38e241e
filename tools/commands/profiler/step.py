"""weldcal profiler step: scale, shear and plane of light of a profiler from profiles of a step target."""

from dataclasses import replace
from typing import Annotated, Any, cast

import numpy as np

from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.reading_choice import step_fit
from weldcal.calibration.profiler.sensor import save_correction
from weldcal.calibration.profiler.step_target import shown_steps, step_sensor
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command, option
from weldcal.tools.commands.profiler.result import (
    FileArgument,
    PosesOption,
    UnitOption,
    check_number,
    read_measurements,
    with_warnings,
)

_NAMES = ("x_scale_percent", "z_scale_percent", "shear_deg")
_UNITS = (100.0, 100.0, 2.0 * np.degrees(1.0))  # the axes are off their right angle by twice the shear


@command(
    "profiler step", keys=("robot-form", "set", "trial", "pitch"), short_help="Calibrate a profiler's scales by a step."
)
def step(
    call: Call,
    file: FileArgument,
    height: Annotated[str, option("--height", "MM", "Height of the step; of several: each, as 10,5.")],
    unit: UnitOption = None,
    poses: PosesOption = None,
) -> Outcome:
    """Calibrate scale and shear of a profiler by profiles of steps of known height, the flange tilted by 15 to 30 deg
    to all sides. Only the orientation of the flange is used. The result is --as sensor-correction=FOLDER of edge and
    sphere."""
    heights = parse_heights(height)
    data = read_measurements(call, file, unit, poses)
    if data.profiles is None:
        raise InputError("The file has no 'profiles' of the step. Give (n, m, 2), or 'xz' with the lengths 'n'.")
    check_number(cast(FlangePoses, data.poses()), (len(data.profiles),), "profiles")
    shown = shown_steps(data.profiles, heights)
    data = data.decided(step_fit(shown), "step")
    X = cast(FlangePoses, data.poses())
    e = step_sensor(X.rotation, data.profiles or (), shown)
    values, sigma = e.correction.values, np.sqrt(np.diag(e.correction.covariance))
    found: dict[str, Any] = {
        "scans": len(X),
        "without_step": np.setdiff1d(np.arange(len(X)), shown.number).tolist(),
        "wrong_scans": list(e.wrong),
        "light_plane_normal_F": e.normal_F.tolist(),
        "sigma_light_plane_deg": float(np.degrees(e.normal_sigma_rad)),
        "reduced_chi2": e.reduced_chi2,
    }
    for name, unit, value, s in zip(_NAMES, _UNITS, values, sigma, strict=True):
        found |= {name: float(unit * value), f"sigma_{name}": float(unit * s)}
    folder = call.folder("profiler", file.stem)
    save_correction(replace(e.correction, figures=found, data_sha256=data.digest), folder)
    return Outcome({"state": "done", **with_warnings(data, found), "written_to": str(folder)})


def parse_heights(text: str) -> Floats:
    """Return the heights (k + 1,) m of the faces over the lowest, from "10" or "10,5" mm.

    Raises:
        InputError: not numbers.
    """
    try:
        return np.concatenate([[0.0], np.cumsum([1e-3 * float(v) for v in text.split(",")])])
    except ValueError as e:
        raise InputError(f"The heights are numbers in mm with commas between, as --height 10,5, not '{text}'.") from e
