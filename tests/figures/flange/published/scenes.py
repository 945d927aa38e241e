"""The published chain from whole scenes: the scene cut down (2.1.4, first step), the circle, all pairs; beside weldcal's."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import open3d as o3d
from pydrake.math import RigidTransform, RollPitchYaw

from tests.figures.flange.published.pipeline import search_circle
from tests.figures.harness import Run, figure
from tests.worlds.flange_frames import facing, flange_frame
from weldcal.calibration.errors import FlangeNotFound
from weldcal.calibration.eye_on_base.solve import SolveConfig, estimate_eye_on_base
from weldcal.calibration.eye_on_base.validation import position_errors
from weldcal.calibration.flange.fit import fit_flange
from weldcal.calibration.flange.observation import Observation, observation_from_fit
from weldcal.calibration.geometry.se3 import fit_rigid
from weldcal.models.arrays import Array
from weldcal.models.flanges import get_flange
from weldcal.models.scanners import get_scanner

FLANGE = get_flange("iso9409-1-50-4-m6")
NEIGHBOURS, RATIO = 50, 1.0
"""Of the statistical filter. The paper names the Point Cloud Library and no numbers; these are of that library's guide."""
PLANE_M, CLUSTER_M, LEAST = 5e-4, 3e-3, 10
PLANES = 8  # the largest are table and housing
EXTENT = (0.85, 1.15)
"""Of a cluster over the flange's diameter: "can not have a range more extensive than the diameter of the tool flange"."""
REPEAT_M = 2e-5  # of the arm, per axis
FOUND_M = 5e-3  # a circle nearer to the truth is the flange


class Cell(NamedTuple):
    """A scanner above the flange: its preset and columns, and the distances m of the flange from it."""

    title: str
    scanner: str
    columns: int
    near_m: float
    far_m: float


CELLS = (Cell("UR10e & PhoXi M", "phoxi_m", 824, 0.58, 0.80), Cell("AUBO i5 & PhoXi S", "phoxi_s", 824, 0.395, 0.43))
X_BC = RigidTransform(RollPitchYaw(np.radians([180.0, 0.0, -90.0])), [-0.65, 0.1, 1.25])


def cut_scene(points: Array, near_m: float, far_m: float) -> list[Array]:
    """Cut a scene (n, 3) m down to the clusters (k, 3) that may be the flange's face: pass-through, filter, planes.

    Planes are taken off the cloud one after the other; of each plane the clusters as large as the flange are kept.
    """
    points = points[(points[:, 2] > near_m) & (points[:, 2] < far_m)]
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud, _ = cloud.remove_statistical_outlier(NEIGHBOURS, RATIO)
    out: list[Array] = []
    for _ in range(PLANES):
        if len(cloud.points) < LEAST:
            break
        _, inliers = cloud.segment_plane(PLANE_M, 3, 1000)
        plane = cloud.select_by_index(inliers)
        labels = np.asarray(plane.cluster_dbscan(CLUSTER_M, LEAST))
        there = np.asarray(plane.points)
        for k in range(labels.max() + 1):
            cluster = there[labels == k]
            if len(cluster) < LEAST:
                continue
            axes = np.linalg.svd(cluster - cluster.mean(axis=0), full_matrices=False)[2]
            extent = float(np.ptp(cluster @ axes[0]))
            if EXTENT[0] * FLANGE.outer_m < extent < EXTENT[1] * FLANGE.outer_m:
                out.append(cluster)
        cloud = cloud.select_by_index(inliers, invert=True)
    return out


def published_centre(points: Array, near_m: float, far_m: float, seed: int = 0) -> Array:
    """Find the centre (3,) m of the published circle in a whole scene; of several clusters that with the most points.

    Raises:
        FlangeNotFound: no cluster is as large as a flange, or holds a circle of its radius.
    """
    best = None
    for cluster in cut_scene(points, near_m, far_m):
        try:
            circle = search_circle(cluster, seed=seed)
        except FlangeNotFound:
            continue
        if best is None or circle.n_inliers > best.n_inliers:
            best = circle
    if best is None:
        raise FlangeNotFound("No cluster of the scene is as large as the flange and holds a circle of its radius.")
    return best.center_C


@dataclass(frozen=True)
class Scenes:
    """What both methods find in the same scenes, and the true centres: observations by scene.

    ``centre_m``: by how much each centre is off.
    """

    published: dict[str, Observation]
    ours: dict[str, Observation]
    true: dict[str, Observation]
    centre_m: dict[str, tuple[float, float]]


def search(cell: Cell, n: int, seed: int) -> Scenes:
    """Render n scenes of the cell and search the flange in each by both methods."""
    rng = np.random.default_rng(seed)
    o3d.utility.random.seed(seed)
    scanner = get_scanner(cell.scanner, cell.columns)
    found = Scenes({}, {}, {}, {})
    for k in range(n):
        p = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(cell.near_m, cell.far_m)])
        X_CR = facing(p, np.radians(rng.uniform(0.0, 25.0)), *rng.uniform(0.0, 2.0 * np.pi, 2))
        scene = flange_frame(scanner, FLANGE, rng, X_CR=X_CR).points_C
        X_BR = X_BC @ X_CR
        X_BR = RigidTransform(X_BR.rotation(), X_BR.translation() + REPEAT_M * rng.normal(size=3))
        found.true[str(k)] = Observation(str(k), X_BR, X_CR.translation())
        flat = scene.reshape(-1, 3)
        flat = flat[np.isfinite(flat).all(axis=1)]
        off = [np.inf, np.inf]
        try:
            centre = published_centre(flat, cell.near_m - 0.05, cell.far_m + 0.05, seed)
            off[0] = float(np.linalg.norm(centre - X_CR.translation()))
            found.published[str(k)] = Observation(str(k), X_BR, centre)
        except FlangeNotFound:
            pass
        try:
            fit = fit_flange(scene, FLANGE)
            off[1] = float(np.linalg.norm(fit.center_C - X_CR.translation()))
            found.ours[str(k)] = observation_from_fit(str(k), X_BR, fit)
        except FlangeNotFound:
            pass
        found.centre_m[str(k)] = (off[0], off[1])
    return found


def held_out(observations: dict[str, Observation], true: dict[str, Observation], *, ours: bool) -> Array:
    """Errors m of a calibration by every second scene, at the true centres of the others."""
    fitted = [o for name, o in observations.items() if int(name) % 2 == 0]
    rest = [o for name, o in true.items() if int(name) % 2]
    if ours:
        X = estimate_eye_on_base(fitted, SolveConfig(leave_one_out=False)).X_BC
    else:
        X = fit_rigid(np.array([o.p_BR for o in fitted]), np.array([o.p_CR for o in fitted]))
    return position_errors(X, rest)


@figure("flange-scenes", "the published chain from whole rendered scenes of both cells, beside weldcal's")
def flange_scenes(run: Run) -> None:
    """Search the flange in whole scenes; calibrate by every second scene and judge on the others."""
    n = run.size(8, 60)
    rows = []
    for cell in CELLS:
        found = search(cell, n, run.seed)
        for column, (method, observations) in enumerate((("published", found.published), ("weldcal", found.ours))):
            off = np.array([pair[column] for pair in found.centre_m.values()])
            right = off < FOUND_M
            e = 1e3 * held_out(observations, found.true, ours=bool(column))
            kept = {k: o for k, o in observations.items() if found.centre_m[k][column] < FOUND_M}
            without = 1e3 * held_out(kept, found.true, ours=bool(column))
            rows.append(
                (
                    f"{cell.title}, {method}",
                    f"{right.sum()} of {n}",
                    f"{(np.isfinite(off) & ~right).sum()}",
                    f"{1e3 * np.median(off[right]):.3f}",
                    f"{np.median(e):.3f}",
                    f"{np.median(without):.3f}",
                    f"{without.max():.3f}",
                )
            )
        run.progress(cell.title, 1.0)
    run.table(
        "Whole scenes",
        (
            "cell",
            "circle found",
            "false",
            "centre off, median mm",
            "held out, median mm",
            "without false ones",
            "largest mm",
        ),
        rows,
    )
