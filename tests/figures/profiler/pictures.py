"""Fig. 4 to 8 of the sphere paper, drawn from one simulated world: S groove, its trajectory and deviations, and boss."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from tests.figures.harness import Run
from tests.figures.profiler.frustum import fit_frustum
from tests.figures.profiler.papers import (
    MM,
    SEAM_FEATURES,
    SPHERE_METHODS,
    calibrations,
    cloud_of,
    seam_features,
    sensed_and_touched,
)
from tests.worlds.profiler import (
    DEPTH_M,
    LENGTH_M,
    SphereWorld,
    WorldData,
    boss_mesh,
    groove_lines,
    scan_boss,
    scan_groove,
    seam_line,
    sphere_trial,
)
from weldcal.calibration.profiler.motion import Floats
from weldcal.tools.report.pictures import OURS, PLANNED, plain, subplots, svg

METHODS = {SPHERE_METHODS[1]: PLANNED, SPHERE_METHODS[3]: OURS}
FACES = ("#b8c4d0", "#e0b040", "#4a90c2", "#c26a4a", "#5aa469", "#8e6bb0")  # of planes 1 to 6
HALF_PLATE_M = 0.07
POINTS = 5000  # of the cloud that are drawn


def sphere_pictures(run: Run) -> None:
    """Draw one world of the seed: the sessions of Fig. 6 are scans of one groove by one calibration."""
    seed, sessions = 1000 * run.seed, run.size(3, 10)
    world = SphereWorld.like_the_files(seed)
    data = WorldData(sphere_trial(world, seed))
    records = {name: record for name, record in calibrations(data).items() if name in METHODS}
    run.write("sphere_fig4.svg", _groove())
    seen: dict[str, list[Floats]] = {name: [] for name in METHODS}
    for k in range(sessions):
        one = replace(data, groove=scan_groove(world, seed + k))
        groove, features = one.groove, seam_features(one)
        assert groove is not None
        assert features is not None
        for name, record in records.items():
            both = [
                sensed_and_touched(record, world.cell.arm, groove.q, features[:, j], groove.q_touch[:, j])
                for j in range(3)
            ]
            seen[name].append(np.array(both) / MM)  # feature, sensed or touched, station, axis
    run.write("sphere_fig5.svg", _trajectories({name: found[0] for name, found in seen.items()}))
    run.write("sphere_fig6.svg", _sessions(seen))
    run.write("sphere_fig7.svg", _boss())
    run.write("sphere_fig8.svg", _cloud(cloud_of(records[SPHERE_METHODS[3]], world.cell.arm, *scan_boss(world, seed))))


def _space(width: float, height: float, count: int = 1) -> tuple[Any, Any]:
    picture, axes = subplots(width, height, 1, count, subplot_kw={"projection": "3d"}, squeeze=False)
    for one in axes[0]:
        one.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
    return picture, axes[0]


def _groove() -> bytes:
    """Fig. 4: the piece, 300 mm long and 60 mm thick, with its S groove."""
    picture, (axes,) = _space(7.0, 4.2)
    u = np.linspace(0.0, LENGTH_M, 121)
    lines = [(-HALF_PLATE_M, 0.0), *groove_lines(DEPTH_M), (HALF_PLATE_M, 0.0)]
    rails = [np.column_stack([seam_line(u, at), np.full(len(u), z)]) / MM for at, z in lines]
    for colour, (one, two) in zip((FACES[0], FACES[2], FACES[3], FACES[0]), pairwise(rails), strict=True):
        axes.plot_surface(*np.stack([one, two]).transpose(2, 0, 1), color=colour, linewidth=0, rstride=1, cstride=1)
    axes.plot(*rails[2].T, color="black", lw=1.0, zorder=5)
    axes.set_aspect("equal")
    axes.set_zticks([-60, 0])
    axes.view_init(78, -80)
    return svg(picture)


def _trajectories(seen: dict[str, Floats]) -> bytes:
    """Fig. 5: the three feature points, sensed and touched, from above."""
    picture, panels = subplots(7.6, 4.6, 2, 1, sharex=True)
    for j, name in enumerate(SEAM_FEATURES):
        for method, found in seen.items():
            sensed, touched = found[j]
            order = np.argsort(touched[:, 0])
            if method == SPHERE_METHODS[1]:
                actual, detected = ("actual (touched)", "detected") if j == 0 else (None, None)
                panels[0].plot(*touched[order, :2].T, color="0.75", lw=3.5, label=actual)
                panels[0].plot(*sensed[order, :2].T, ".", ms=4, color="black", label=detected)
            panels[1].plot(
                touched[order, 0],
                np.linalg.norm(sensed - touched, axis=1)[order],
                ("-", "--", ":")[j],
                color=METHODS[method],
                lw=1.2,
                label=f"{method}, {name}",
            )
    plain(panels[0], "", "y, mm")
    plain(panels[1], "x, mm", "sensed to actual, mm")
    panels[0].legend(frameon=False, fontsize=8)
    panels[1].legend(frameon=False, fontsize=7, ncol=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    panels[1].set_ylim(bottom=0.0)
    return svg(picture)


def _sessions(seen: dict[str, list[Floats]]) -> bytes:
    """Fig. 6: the mean deviation of each feature point in each session."""
    picture, panels = subplots(7.6, 2.8, 1, 3, sharey=True)
    for j, name in enumerate(SEAM_FEATURES):
        for method, found in seen.items():
            off = [float(np.linalg.norm(one[j, 0] - one[j, 1], axis=1).mean()) for one in found]
            panels[j].plot(np.arange(1, len(off) + 1), off, "o-", ms=4, lw=1.2, color=METHODS[method], label=method)
        panels[j].set_title(name, fontsize=9)
        panels[j].set_xticks(np.arange(1, len(off) + 1))
        plain(panels[j], "session", "mean deviation, mm" if j == 0 else "")
    panels[0].set_ylim(bottom=0.0)
    panels[2].legend(frameon=False, fontsize=8)
    return svg(picture)


def _boss() -> bytes:
    """Fig. 7: the boss with the numbers of its planes."""
    picture, (axes,) = _space(5.2, 4.2)
    mesh = boss_mesh()
    v = mesh.vertices / MM
    v[:4, :2] *= 0.3  # the plate goes on
    quads = [[0, 1, 2, 3], [8, 9, 10, 11], *([4 + i, 4 + (i + 1) % 4, 8 + (i + 1) % 4, 8 + i] for i in range(4))]
    axes.add_collection3d(Poly3DCollection([v[q] for q in quads], facecolors=FACES, edgecolors="0.2", alpha=0.85))
    for number, q in enumerate(quads, 1):
        at = v[q].mean(axis=0) if number > 1 else np.array([52.0, -52.0, 0.0])
        at = at * [1.25, 1.25, 1.0] if number > 2 else at  # in front of its face
        axes.text(*at, str(number), ha="center", fontsize=12, zorder=10)
    axes.set(xlim=(-60, 60), ylim=(-60, 60), zlim=(0, 40), zticks=[0, 20, 40])
    axes.set_aspect("equal")
    axes.view_init(58, -60)
    return svg(picture)


def _cloud(cloud: Floats) -> bytes:
    """Fig. 8: the cloud by the joint calibration, and the planes found in it."""
    found = fit_frustum(cloud)
    p = (cloud - cloud.mean(axis=0)) / MM
    picture, panels = _space(9.0, 4.2, 2)
    some = np.linspace(0, len(p) - 1, POINTS).astype(int)
    panels[0].scatter(*p[some].T, s=1.0, c=p[some, 2], cmap="viridis", rasterized=True)
    for label, colour in enumerate(FACES):
        at = some[found.labels[some] == label]
        panels[1].scatter(*p[at].T, s=1.0, color=colour, rasterized=True)
        x, y, z = p[at].mean(axis=0) if label else p[at[np.argmax(np.linalg.norm(p[at], axis=1))]] * [0.85, 0.85, 1.0]
        panels[1].text(x, y, z + 6.0, str(label + 1), fontsize=12, zorder=10, ha="center")
    for axes, title in zip(panels, ("a: point cloud", "b: planes 1 to 6"), strict=True):
        axes.set_title(title, fontsize=9)
        axes.set_zticks([0, 30])
        axes.set_aspect("equal")
        axes.view_init(72, -60)
    return svg(picture)
