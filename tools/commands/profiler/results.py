"""Completes a profiler calibration from a file: errors of scans that were left out, the files of the result and its report."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from weldcal.calibration.profiler.edge.joint import edge_joint
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.record import ProfilerRecord
from weldcal.calibration.profiler.sphere.joint import Model, leave_one_out_m
from weldcal.calibration.profiler.sphere.model import SphereData, SphereSigmas
from weldcal.models.errors import WeldcalError
from weldcal.tools.commands.profiler import files
from weldcal.tools.commands.profiler.calibrate import edge_points, write_calibration
from weldcal.tools.outcomes.profiler_file import ProfilerFile
from weldcal.tools.report.profiler_file import profiler_report
from weldcal.tools.report.render import write_atomic

FOLDS = 5
_MANY = 2000  # points of a report's picture


def finish_edge(
    file: files.ProfilerFile, feature: str, side: str, record: ProfilerRecord, found: dict[str, Any], source: str,
    out: Path, limit_mm: float | None,
) -> tuple[ProfilerFile, dict[str, Any]]:  # fmt: skip
    """Write an edge's calibration and its report; the result, and its JSON object without the folder."""
    points, _ = edge_points(file, feature, side)
    keep = np.asarray(np.isfinite(points).all(axis=1), bool)
    held = np.zeros(0)
    if "sigmas_mm" in found:  # the paper's method has no sigmas, and nothing is left out
        held = edge_held_out(cast(FlangePoses, file.poses())[keep], points[keep], found["sigmas_mm"])
    return _finish(record, found, points[keep], held, source, out, limit_mm)


def finish_sphere(
    data: SphereData, sigmas: SphereSigmas, record: ProfilerRecord, found: dict[str, Any], source: str, out: Path,
    limit_mm: float | None,
) -> tuple[ProfilerFile, dict[str, Any]]:  # fmt: skip
    """Write a sphere's calibration and its report; the result, and its JSON object without the folder."""
    held = np.zeros(0)
    if "model" in found:  # the published method cannot leave a scan out
        model = cast(Model, found["model"])
        whole = data if model == "affine+joints" else replace(data, arm=None, q=None, touch_q=None)
        try:
            held = 1e3 * leave_one_out_m(whole, model, sigmas)
        except WeldcalError:  # too few scans to leave any out
            held = np.zeros(0)
        used = np.ones(len(held), bool)
        used[[k for k in found.get("wrong_scans", ()) if k < len(held)]] = False
        held = held[used]
    return _finish(record, found, np.vstack(data.profiles), held, source, out, limit_mm)


def edge_held_out(poses: FlangePoses, points: Floats, sigmas_mm: Mapping[str, float]) -> Floats:
    """Distance (n,) mm of each point (n, 2) m from the edge of a calibration without its fifth of the scans; NaN where there is none."""
    found, n = np.full(len(points), np.nan), len(points)
    for fold in range(FOLDS):
        out = np.arange(n) % FOLDS == fold
        try:
            e = edge_joint(
                poses.rotation[~out], poses.translation[~out], points[~out], sigma_robot_m=1e-3 * sigmas_mm["robot"],
                sigma_xz_m=1e-3 * np.array([sigmas_mm["x"], sigmas_mm["z"]]),
            )  # fmt: skip
        except WeldcalError:  # the others do not determine the pose
            continue
        p_S = np.column_stack([points[out, 0], np.zeros(out.sum()), points[out, 1]])
        p_F = p_S @ e.rotation.T + e.translation
        away = np.einsum("nij,nj->ni", poses.rotation[out], p_F) + poses.translation[out] - e.point
        away -= np.outer(away @ e.direction, e.direction)
        found[out] = 1e3 * np.linalg.norm(away, axis=1)
    return found


def _finish(
    record: ProfilerRecord, found: dict[str, Any], points: Floats, held_mm: Floats, source: str, out: Path,
    limit_mm: float | None,
) -> tuple[ProfilerFile, dict[str, Any]]:  # fmt: skip
    points = points[np.isfinite(points).all(axis=1)]
    made = ProfilerFile(
        record=record,
        found=found,
        points=points[:: max(1, len(points) // _MANY)],
        held_out_mm=held_mm,
        source=source,
        out=out,
        limit_mm=limit_mm,
    )
    written = write_calibration(record, out)
    write_atomic(out / "report.html", profiler_report(made))
    return made, {**found, **written}
