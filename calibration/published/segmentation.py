"""The paper's segmentation of a flange face: pass-through, statistical outlier removal, clustering, dominant plane."""

from dataclasses import dataclass

import numpy as np

from weldcal.calibration.errors import FlangeNotFound
from weldcal.models.arrays import Array


@dataclass(frozen=True, kw_only=True)
class SegmentationParameters:
    """Numbers of the segmentation, m. Section 2.1.4 names the steps but no number; these are the ones that the authors
    published beside the paper for the UR10e: filters of 50 neighbours and one standard deviation, applied twice, clusters
    of 8 000 to 100 000 points linked over 0.5 mm, and a face of 0.9 to 1.1 flange diameters."""

    depth_m: tuple[float, float] = (0.4, 1.0)
    neighbours: int = 50
    deviations: float = 1.0
    passes: int = 2
    link_m: float = 0.0005
    cluster_points: tuple[int, int] = (8_000, 100_000)
    plane_m: float = 0.001
    plane_draws: int = 10_000
    width_in_diameters: tuple[float, float] = (0.9, 1.1)
    depth_in_diameters: float = 0.55


def segment_flange(
    points_C: Array, radius_m: float = 0.031, parameters: SegmentationParameters | None = None, *, seed: int = 0
) -> Array:
    """The points (n, 3) m of the first cluster whose dominant plane has about the size of a flange of that radius.

    ``points_C``: a scene (N, 3) or (H, W, 3) m, NaN where invalid. Source: paper, section 2.1.4, first step; the largest
    clusters are tried first. Its failings are kept: the size is measured along the camera's axes, so a flange that leans
    is narrower than allowed; the fixed number of points ties it to one resolution and distance; a plate of the same size
    passes (three did for the UR5, section 3.2.2). Deterministic for ``seed``. Raises FlangeNotFound, saying at which
    step nothing was left.
    """
    import open3d as o3d  # slow to import

    p = parameters or SegmentationParameters()
    flat = np.asarray(points_C, dtype=float).reshape(-1, 3)
    flat = flat[np.isfinite(flat).all(axis=1)]
    flat = flat[(flat[:, 2] > p.depth_m[0]) & (flat[:, 2] < p.depth_m[1])]
    if len(flat) <= p.neighbours:
        raise FlangeNotFound(f"The published pass-through from {p.depth_m[0]:g} to {p.depth_m[1]:g} m leaves no scene.")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(flat))
    for _ in range(p.passes):
        cloud, _kept = cloud.remove_statistical_outlier(p.neighbours, p.deviations)
    # Euclidean clusters are DBSCAN's in which every point is a core point
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        labels = np.asarray(cloud.cluster_dbscan(eps=p.link_m, min_points=1))
    names, sizes = np.unique(labels[labels >= 0], return_counts=True)
    allowed = (sizes >= p.cluster_points[0]) & (sizes <= p.cluster_points[1])
    if not allowed.any():
        largest = int(sizes.max(initial=0))
        raise FlangeNotFound(
            f"No cluster has the published {p.cluster_points[0]} to {p.cluster_points[1]} points; the largest has {largest}."
        )
    o3d.utility.random.seed(seed)
    diameter = 2.0 * radius_m
    for name in names[allowed][np.argsort(-sizes[allowed], kind="stable")]:
        cluster = cloud.select_by_index(np.nonzero(labels == name)[0].tolist())
        _model, inliers = cluster.segment_plane(p.plane_m, 3, p.plane_draws)
        face = np.asarray(cluster.points)[np.asarray(inliers, dtype=int)]
        extent = np.ptp(face, axis=0) / diameter
        low, high = p.width_in_diameters
        if low < extent[0] < high and low < extent[1] < high and extent[2] < p.depth_in_diameters:
            return np.asarray(face)
    raise FlangeNotFound("No cluster of the published size has a plane as wide as the flange.")
