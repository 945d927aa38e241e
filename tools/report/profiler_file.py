"""The report pages of `weldcal profiler edge`, `sphere`, `compensate` and `seam`."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from weldcal.models.arrays import Array
from weldcal.tools.outcomes.profiler_file import ProfilerFile, ProfilerSeam
from weldcal.tools.report.pictures import OURS, error_bars, svg
from weldcal.tools.report.render import fixed, fixed_row, render

_NAMES = {
    "scans": ("scans", ""),
    "touches": ("touches", ""),
    "inliers": ("points used", ""),
    "found": ("profiles with a groove", ""),
    "model": ("model", ""),
    "model_reason": ("why this model", ""),
    "method": ("method", ""),
    "rms_mm": ("residual, rms", "mm"),
    "reduced_chi2": ("reduced chi-square, 1 where the stated sigmas are right", ""),
    "condition": ("condition of the scans, 1 at best", ""),
    "sigma_translation_mm": ("one sigma of the position", "mm"),
    "sigma_rotation_deg": ("one sigma of the rotation", "deg"),
    "radius_of_profiles_mm": ("radius that the profiles show", "mm"),
    "mean_distance_mm": ("mean distance of the points from the edge", "mm"),
    "touch_rms_mm": ("touches off the sphere, rms", "mm"),
    "centre_before_mm": ("centres apart before the compensation", "mm"),
    "centre_after_mm": ("centres apart after the compensation", "mm"),
}


def profiler_report(made: ProfilerFile) -> str:
    """The page of a calibration from a file, as one self-contained HTML text."""
    held = made.held_out_mm
    judged = bool(np.isfinite(held).any())
    sigma = None if made.record.covariance is None else np.sqrt(np.diag(made.record.covariance))
    return render(
        "profiler_file.html.j2",
        first=made.first,
        title=f"Profiler calibration from {made.source}",
        subtitle=f"Method: {made.record.method}.",
        bars=error_bars([str(k) for k in range(len(held))], held, np.ones(len(held), bool), "left-out scan, mm")
        if judged
        else None,
        seen=_seen(made.points),
        seam=None,
        rows=_rows(made.found),
        sigma=[]
        if sigma is None
        else [
            ("one sigma of the position, mm", fixed_row(1e3 * sigma[3:], 3)),
            ("one sigma of the rotation, deg", fixed_row(np.degrees(sigma[:3]), 4)),
        ],
        warnings=list(made.found.get("warnings", ())),
        lists=_lists(made.found),
        digest=made.record.data_sha256,
    )


def seam_report(seam: ProfilerSeam) -> str:
    """The page of a mapped seam, as one self-contained HTML text."""
    return render(
        "profiler_file.html.j2",
        first=seam.first,
        title=f"Seam mapped from {seam.source}",
        subtitle=f"In the robot's base, by the calibration {seam.calibration}.",
        bars=None,
        seen=None,
        seam=_line(seam.root_mm),
        rows=_rows(seam.found),
        sigma=[],
        warnings=list(seam.found.get("warnings", ())),
        lists=_lists(seam.found),
        digest="",
    )


def _rows(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The short values of a result, by the names of a person."""
    rows = []
    for key, (name, unit) in _NAMES.items():
        value = found.get(key)
        if value is not None:
            text = fixed(value, 4) if isinstance(value, float) else str(value)
            rows.append((name, f"{text} {unit}".strip()))
    return rows


def _lists(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Numbers of scans that were not used, by the reason."""
    keys: Sequence[str] = [k for k, v in found.items() if isinstance(v, list) and v and k != "warnings"]
    return [(k.replace("_", " "), ", ".join(map(str, found[k]))) for k in keys if k != "next_poses"]


def _seen(points: Array) -> bytes:
    """Where in the scan plane the points (n, 2) m were measured: the calibration is good there."""
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(1e3 * points[:, 0], 1e3 * points[:, 1], ".", color=OURS, markersize=2.5)
    axes.plot(*(1e3 * points.mean(axis=0)), "+", color="#000000", markersize=12, markeredgewidth=1.6)
    axes.set_xlabel("x in the scan plane, mm")
    axes.set_ylabel("z, mm")
    axes.invert_yaxis()
    axes.set_aspect("equal", adjustable="datalim")
    return svg(figure, axes)


def _line(root_mm: Array) -> bytes:
    """The root (n, 3) mm of a groove in the base, from above and from the side."""
    figure = Figure(figsize=(8.2, 3.6), layout="constrained")
    both = figure.subplots(1, 2)
    for axes, (i, j), title in zip(both, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        axes.plot(root_mm[:, i], root_mm[:, j], ".", color=OURS, markersize=4)
        axes.set_xlabel(f"base {'xyz'[i]}, mm")
        axes.set_ylabel(f"base {'xyz'[j]}, mm")
        axes.set_title(title, fontsize=10, loc="left")
        axes.margins(0.1)
    return svg(figure, *both)
