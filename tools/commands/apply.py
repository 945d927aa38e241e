"""weldcal apply: correct the points of a scan as a calibration expects them, in the scanner's or the robot's frame."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import UNITS, cloud_unit
from weldcal.calibration.data.clouds import cloud_id, read_cloud
from weldcal.calibration.data.results import load_correction, load_result
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError
from weldcal.tools.cli.options import Call, Outcome, command, option, switch

FORMS = (".ply", ".pcd", ".xyz", ".txt", ".csv", ".npy", ".npz")


@command("apply", common=("overwrite", "json", "debug"), short_help="Correct the points of a scan by a calibration.")
def apply(
    call: Call,
    result: Annotated[Path, typer.Argument(metavar="RESULT", help="Folder of a result, or its YAML file.")],
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="A scan: PLY, PCD, NPZ, NPY, text, depth image.")],
    to: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help=f"File to write ({', '.join(FORMS)}); without it CLOUD_corrected.ply, here.",
            show_default=False,
            writable=True,
        ),
    ] = None,
    *,
    base: Annotated[bool, switch("--base", "Give the points in the robot's base B, by X_BC.")] = False,
    unit: Annotated[
        str, option("--unit", "UNIT", "Unit of CLOUD and FILE: m or mm.", show_default="by the distances")
    ] = "",
) -> Outcome:
    """Correct a scan for the scanner's own errors, as the calibration found them; --base: also map it into the base."""
    correction = load_correction(result)
    X_BC = load_result(result).X_BC if base else RigidTransform()
    to = to or Path(f"{cloud_id(cloud)}_{'base' if base else 'corrected'}.ply")
    if to.suffix.lower() not in FORMS:
        raise InputError(f"'{to.name}' has no form that can be written: end its name with {', '.join(FORMS)}.")
    if to.exists() and not call.given["overwrite"]:
        raise InputError(f"'{to}' exists: give another file, or add --overwrite.")
    if unit not in ("", "m", "mm"):
        raise InputError(f"--unit must be m or mm, not '{unit}'.")
    given = read_cloud(cloud)
    length = UNITS[unit or cloud_unit(given, cloud.name)]
    measured = length * given
    corrected = measured if correction is None else correction.points(measured)
    points = corrected @ X_BC.rotation().matrix().T + X_BC.translation()
    moved = 1e3 * np.nanmean(np.linalg.norm(corrected - measured, axis=-1))
    write_points(to, points / length)
    frame = "robot's base B" if base else "scanner C"
    values = {
        "points": int(np.isfinite(points).all(axis=-1).sum()),
        "unit": "m" if length == 1.0 else "mm",
        "frame": frame,
        "mean_correction_mm": float(moved),
        "note": "" if correction else "This calibration has no scanner correction: no point changed.",
        "file": str(to),
    }
    return Outcome({"state": "done", **values}, values=values)


def write_points(path: Path, points: Array) -> None:
    """Write (N, 3) or (H, W, 3) points; a list has only the measured ones, NPY and NPZ keep their order and NaN."""
    suffix = path.suffix.lower()
    flat = points.reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1)]
    if suffix == ".npy":
        np.save(path, points)
    elif suffix == ".npz":
        np.savez_compressed(path, points=points)
    elif suffix in (".ply", ".pcd"):
        import open3d as o3d  # slow to import

        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(flat))
        if not o3d.io.write_point_cloud(path, cloud):
            raise InputError(f"'{path}' cannot be written: check that its folder exists and is writable.")
    else:
        np.savetxt(
            path,
            flat,
            fmt="%.9g",
            delimiter="," if suffix == ".csv" else " ",
            comments="",
            header="x,y,z" if suffix == ".csv" else "",
        )
