"""What the fixed files hold besides both papers' tables: free poses, outliers, degenerate sets, raw profiles, a real sphere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from weldcal.calibration.profiler.edge.features import extract_edge
from weldcal.calibration.profiler.edge.joint import EdgeEstimate, edge_joint
from weldcal.calibration.profiler.edge.linear import edge_linear
from weldcal.calibration.profiler.edge.model import EdgeState, predicted
from weldcal.calibration.profiler.features.groove import groove_features
from weldcal.calibration.profiler.motion import FlangePoses, Floats
from weldcal.calibration.profiler.sphere.arc import find_arc
from weldcal.calibration.profiler.sphere.joint import leave_one_out_m
from weldcal.calibration.profiler.sphere.model import SphereData
from weldcal.models.errors import InputError, WeldcalError
from weldcal.tools.studies.profiler.sets import MM, NOISE, EdgeTrial, fixed_edge_trials
from weldcal.tools.studies.profiler.sphere import METHODS, WorldResult, fixed_worlds

Line = tuple[str, str, float, float]  # what, unit, reached, target: met where not above
DEGENERATE = {
    "collinear": "positions on a line",
    "along_edge": "motion along the edge",
    "one_rotation": "one orientation",
    "two_rotations": "two orientations",
    "one_axis": "one axis of turning",
    "two_edges": "points of two edges",
}
FILES = (
    "edge_features.npz", "edge_sphere.npz", "edge_profiles.npz", "sphere.npz", "groove.npz", "boss.npz", "real_sphere15_a.npz",
)  # fmt: skip
FREE = {"nominal": (0.107, 0.123), "paper": (0.36, 0.42)}
RAW: tuple[tuple[str, Literal["bar", "step", "apex"], tuple[float, float]], ...] = (
    ("bar", "bar", (0.050, 0.031)),
    ("blade", "apex", (0.006, 0.012)),
)
SOLVED = (0.31, 0.30)  # deg, mm: farther off, the paper's method, which states no covariance, is wrong
SILENT = 22.5  # normalised error squared that one sound answer of a thousand exceeds (chi-square, 6 degrees)
FEATURES = (0.02, 0.035, 0.02)
PUBLISHED = {METHODS[0]: 4.523, METHODS[1]: 0.840}


@dataclass(frozen=True)
class _Error:
    """Of one calibration: rotation deg, translation mm, normalised error squared over six numbers (NaN without a covariance)."""

    deg: float
    mm: float
    nees: float


def told(value: float, unit: str) -> str:
    """A figure with its unit, as tables show it: counts whole, what is tiny by its power of ten."""
    if unit == "points" or unit.startswith("of "):
        return f"{value:.0f} {unit}"
    return (f"{value:.3f}" if value >= 5e-4 or value == 0.0 else f"{value:.1e}") + (f" {unit}" if unit else "")


def require_files(folder: Path) -> None:
    """Say what is missing before any work.

    Raises:
        InputError: a file of FILES is not there.
    """
    for name in FILES:
        if not (folder / name).is_file():
            raise InputError(
                f"There is no {name} in '{folder}': give the folder of all fixed files, take --quick, or leave --data away to make "
                "trials from seeds."
            )


def fixed_lines(folder: Path, progress: Callable[[str, float], None]) -> list[Line]:
    """All of it.

    Raises:
        InputError: a file is not there.
    """
    require_files(folder)
    steps: tuple[tuple[str, Callable[[], Iterator[Line]]], ...] = (
        ("without noise", lambda: _exact(folder)),
        ("free poses", lambda: _free(folder)),
        ("outliers", lambda: _outliers(folder)),
        ("degenerate sets", lambda: _degenerate(folder)),
        ("raw profiles", lambda: _raw(folder)),
        ("groove", lambda: _groove(folder)),
        ("arcs", lambda: _arcs(folder)),
        ("real sphere", lambda: _real(folder)),
    )
    lines: list[Line] = []
    for k, (name, step) in enumerate(steps):
        progress(name, k / len(steps))
        lines += step()
    return lines


def _joint(trial: EdgeTrial) -> EdgeEstimate:
    return edge_joint(
        trial.poses.rotation, trial.poses.translation, trial.points, sigma_robot_m=trial.noise.robot_m, sigma_xz_m=trial.noise.xz_m
    )  # fmt: skip


def _off(truth: EdgeState, rotation: Floats, translation: Floats, covariance: Floats | None = None) -> _Error:
    off = np.concatenate(
        [Rotation.from_matrix(truth.rotation @ rotation.T).as_rotvec(), truth.translation - translation]
    )
    nees = np.nan if covariance is None else float(off @ np.linalg.solve(covariance, off))
    return _Error(float(np.degrees(np.linalg.norm(off[:3]))), float(np.linalg.norm(off[3:])) / MM, nees)


def _rms(errors: list[_Error]) -> tuple[float, float]:
    deg, mm = (np.sqrt(np.mean(np.square([getattr(e, name) for e in errors]))) for name in ("deg", "mm"))
    return float(deg), float(mm)


def _exact(folder: Path) -> Iterator[Line]:
    """Noise left away: both methods must come to the truth."""
    trial = next(fixed_edge_trials(folder, "tilt_nominal"))
    points = predicted(trial.truth, trial.poses)[0]
    R, t = trial.poses.rotation, trial.poses.translation
    group = np.repeat(np.arange(25), 10)
    linear = edge_linear(R, t, points, group)
    joint = edge_joint(R, t, points, sigma_robot_m=trial.noise.robot_m, sigma_xz_m=trial.noise.xz_m)
    for name, found in (("the paper's method", linear), ("joint", joint)):
        off = _off(trial.truth, found.rotation, found.translation)
        yield f"edge without noise, {name}, rotation", "deg", off.deg, 1e-8
        yield f"edge without noise, {name}, translation", "mm", off.mm, 1e-8


def _free(folder: Path) -> Iterator[Line]:
    """40 free poses and no initial guess; every trial counts, so one that went astray would show."""
    nees: list[float] = []
    for level, (deg, mm) in FREE.items():
        found = []
        for trial in fixed_edge_trials(folder, f"free_{level}"):
            e = _joint(trial)
            found.append(_off(trial.truth, e.rotation, e.translation, e.covariance))
        nees += [e.nees for e in found]
        reached = _rms(found)
        yield f"40 free poses, {level} noise, {len(found)} sets, rotation", "deg", reached[0], deg
        yield f"40 free poses, {level} noise, {len(found)} sets, translation", "mm", reached[1], mm
    yield "40 free poses, normalised error squared of 6 numbers", "", float(np.mean(nees)), 8.0


def _outliers(folder: Path) -> Iterator[Line]:
    found, missed, wronged = [], 0, 0
    for trial in fixed_edge_trials(folder, "outlier_nominal"):
        e = _joint(trial)
        assert trial.wrong is not None
        found.append(_off(trial.truth, e.rotation, e.translation))
        missed += int((e.inliers & trial.wrong).sum())
        wronged += int((~e.inliers & ~trial.wrong).sum())
    reached = _rms(found)
    yield "a tenth of outliers, rotation", "deg", reached[0], 0.071
    yield "a tenth of outliers, translation", "mm", reached[1], 0.095
    yield "a tenth of outliers, not named", "points", missed, 0.0
    yield "a tenth of outliers, named without being one", "points", wronged, 0.0


def _degenerate(folder: Path) -> Iterator[Line]:
    """Sets that leave something open: how many answers were wrong and did not say so, by their covariance where they have one."""
    with np.load(folder / "edge_features.npz") as d:
        truth = EdgeState(d["truth_Rs"], d["truth_Ts"] * MM, d["truth_p0"] * MM, d["truth_e"])
        sets = {name: [d[f"degen_{name}_{part}"] for part in ("Rb", "Tb", "ps")] for name in DEGENERATE}
    for name, arrays in sets.items():
        solved, silent = [], {"the paper's method": 0, "joint": 0}
        for R, t, p in zip(*arrays, strict=True):
            trial = EdgeTrial(FlangePoses(R, t * MM), p * MM, truth, NOISE["nominal"])
            with suppress(WeldcalError):
                found = edge_linear(R, t * MM, p * MM)
                linear = _off(truth, found.rotation, found.translation)
                silent["the paper's method"] += linear.deg > SOLVED[0] or linear.mm > SOLVED[1]
            with suppress(WeldcalError):
                e = _joint(trial)
                off = _off(truth, e.rotation, e.translation, e.covariance)
                turn, shift = (float(np.sqrt(np.trace(part))) for part in (e.covariance[:3, :3], e.covariance[3:, 3:]))
                solved.append((off, _Error(float(np.degrees(turn)), shift / MM, np.nan)))
                silent["joint"] += off.nees > SILENT
        how = ""
        if solved:
            reached, bound = _rms([x for x, _ in solved]), _rms([x for _, x in solved])
            how = f" (solved to {reached[0]:.2f} deg, {reached[1]:.2f} mm; its sigma: {bound[0]:.2f}, {bound[1]:.2f})"
        words = f"edge, {DEGENERATE[name]}"
        of = f"of {len(arrays[0])}"
        yield f"{words}, the paper's method: wrong without a word", of, silent["the paper's method"], 0.0
        yield f"{words}, joint: wrong without a word{how}", of, silent["joint"], 0.0


def _raw(folder: Path) -> Iterator[Line]:
    with np.load(folder / "edge_profiles.npz") as d:
        for name, kind, limits in RAW:
            errors = [
                extract_edge(profile * MM, kind)[0] / MM - truth
                for profile, truth in zip(d[f"{name}_prof"], d[f"{name}_truth"], strict=True)
            ]
            for axis, spread, limit in zip("xz", np.std(errors, axis=0), limits, strict=True):
                yield f"edge of a {name} in a raw profile, {axis}", "mm", float(spread), limit


def published_lines(sphere: list[WorldResult]) -> Iterator[Line]:
    """Of the study's worlds: the sphere paper's own method must be that method: its figures on these files are known."""
    for method, known in PUBLISHED.items():
        mean = float(np.mean([r.points_mm.mean() for r in sphere if r.method == method]))
        yield f"sphere, the paper's method, {method}: off its known {known} mm", "mm", abs(mean - known), 0.01


def _groove(folder: Path) -> Iterator[Line]:
    """The groove's features in raw profiles, before any calibration."""
    off = []
    for world in fixed_worlds(folder, 3):
        assert world.groove is not None
        found = np.array([groove_features(p).points for p in world.groove.profiles])
        off.append(np.linalg.norm(found - world.groove.features, axis=2).mean(axis=0) / MM)
    for name, value, limit in zip(("first edge", "root", "second edge"), np.mean(off, axis=0), FEATURES, strict=True):
        yield f"groove in a raw profile, {name}", "mm", float(value), limit


def _arcs(folder: Path) -> Iterator[Line]:
    """The ball's arc is found in every profile."""
    lost = seen = 0
    for world in fixed_worlds(folder, 8):
        data = world.trial.data
        for profile in data.profiles:
            seen += 1
            try:
                find_arc(profile, data.radius_m)
            except WeldcalError:
                lost += 1
    yield "sphere, arcs not found", f"of {seen}", lost, 0.0


def _real(folder: Path) -> Iterator[Line]:
    with np.load(folder / "real_sphere15_a.npz") as z:
        T, parts = z["T_base_flange"], np.split(z["xz"] * MM, np.cumsum(z["n"])[:-1])
    data = SphereData(FlangePoses(T[:, :3, :3], T[:, :3, 3] * MM), [p[::8] for p in parts], 40 * MM)
    off = float(np.sqrt((leave_one_out_m(data, "rigid") ** 2).mean())) / MM
    yield "real sphere, the scan left out, rms", "mm", off, 0.152
