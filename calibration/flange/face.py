"""Fit the concentric edges of a flat face, by sectors where there is no pixel grid, and test whether it is a flange."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from weldcal.calibration.errors import CircleFitError, PlaneFitError
from weldcal.calibration.geometry.primitives import CircleFit, PlaneFit, fit_circle, fit_plane
from weldcal.models.arrays import Array
from weldcal.models.flanges import FlangeStandard

# point pitches of a sector: so narrow that many edge points average, yet none is empty
_SECTOR_PITCHES = 3.0

_CHAMFER_M = 0.0025  # a surface that goes on at most this far below the face is its chamfer, not another part
_CHAMFER_SHARE = 0.2  # of the edge: more than flying pixels and noise could make look so
_HIDDEN_LESS = 0.25  # of the chamfer: the half of an edge that hides its wall loses more pixels, and counts less
_WIDEST = 1.5  # connected parts much wider than a flange are tables and plates
_ALONE = 0.5  # of the outer edge; less of it counts only beside a part of the bore
# a choice: a quarter of the bore's edge still places its centre, beside less than half of the outer edge
_BORE_SEEN = 0.25
_FILLED = 0.4  # share of the bore's core that must not be face
_HOLLOW = 0.7  # share of the ring between the edges that must be face; its holes take up to a seventh of it
_FULL = 0.85  # and must be where the bore's edge itself was not found
_SLOTTED = 0.4  # and where the face shows all round both edges: slots between them take half of it on some arms
_ALL_ROUND = 0.9  # of the directions
_MIXED, _MOST_MIXED = 1.5, 0.2  # pitches, and at most this share of the ring


def plane_axes(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete ``normal`` (3,) to a right-handed orthonormal frame; deterministic."""
    x, y, z = (float(v) for v in normal)
    least = min((abs(x), 0), (abs(y), 1), (abs(z), 2))[1]
    # the cross product of the axis that lies flattest with the normal, written out: np.cross costs 20 microseconds
    e = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))[least]
    length = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]) ** 0.5
    a, b, c = e[0] / length, e[1] / length, e[2] / length
    return np.array([a, b, c]), np.array([y * c - z * b, z * a - x * c, x * b - y * a])


def sector_edges(xy: Array, center: Array, pitch: float, *, outer: bool, band: tuple[float, float]) -> Array:
    """Outermost (or innermost) points per sector about ``center`` of a face given as points (N, 2) m; (K, 2).

    Only points at a radius within ``band`` [m] count. The edge is found short by a fraction of the pitch all round,
    which changes the radius and not the centre.
    """
    d = xy - center
    rho = np.hypot(d[:, 0], d[:, 1])
    near = (rho > band[0]) & (rho < band[1])
    if not near.any():
        return np.zeros((0, 2))
    d, rho, xy = d[near], rho[near], xy[near]
    radius = 0.5 * (band[0] + band[1])
    sectors = sector_count(radius, pitch)
    sector = np.floor((np.arctan2(d[:, 1], d[:, 0]) + np.pi) / (2.0 * np.pi) * sectors).astype(int) % sectors
    order = np.lexsort((-rho if outer else rho, sector))
    first = np.unique(sector[order], return_index=True)[1]
    return np.asarray(xy[order[first]])


def sector_count(radius: float, pitch: float) -> int:
    """Number of sectors for an edge of that radius (m) and point pitch (m)."""
    return int(np.clip(2.0 * np.pi * radius / (_SECTOR_PITCHES * pitch), 24, 720))


def coverage(points: Array, center: Array, sectors: int = 72) -> float:
    """Share (0..1) of the directions about ``center`` in which at least one of the points (N, 2) lies."""
    if len(points) == 0:
        return 0.0
    d = points - center
    sector = np.floor((np.arctan2(d[:, 1], d[:, 0]) + np.pi) / (2.0 * np.pi) * sectors).astype(int) % sectors
    return len(np.unique(sector)) / sectors


def connected_parts(xy: Array, cell: float) -> NDArray[np.intp]:
    """Label (N,) of the connected part each point (N, 2) m belongs to, on a raster of ``cell`` [m].

    Largest part is 0.
    """
    grid = np.floor((xy - xy.min(axis=0)) / cell).astype(int) + 1
    image = np.zeros(grid.max(axis=0) + 2, dtype=bool)
    image[grid[:, 0], grid[:, 1]] = True
    labels, _ = ndimage.label(image, structure=np.ones((3, 3)))
    return _by_size(np.asarray(labels[grid[:, 0], grid[:, 1]], dtype=np.intp))


def _by_size(part: NDArray[np.intp]) -> NDArray[np.intp]:
    values, inverse, counts = np.unique(part, return_inverse=True, return_counts=True)
    rank = np.empty(len(values), dtype=int)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(values))
    return np.asarray(rank[inverse])


@dataclass(frozen=True, kw_only=True)
class FlangeFitConfig:
    """Acceptance limits of the flange fit.

    Lengths in m; the defaults suit structured-light scanners and admit time-of- flight ones. Below half of the outer
    edge, ``min_coverage`` of it is enough only beside a quarter of a concentric bore.
    """

    seed: int = 0
    hypothesis_tolerance_m: float = 0.0008
    radius_tolerance: float = 0.05
    min_coverage: float = 0.35
    max_plane_rms_m: float = 0.0015
    max_rim_rms_m: float = 0.0006
    max_guess_tilt_rad: float = 0.8
    min_points: int = 120


# 0.25 m/s over an exposure of 10 ms smears an edge by 2.5 mm, 0.7 mm rms, and pixel noise adds half a millimetre
IN_MOTION = FlangeFitConfig(max_rim_rms_m=0.0012)
"""How a frame taken in motion is fitted, live and in a recording."""


@dataclass
class FaceRefusal:
    """The reason of the candidate that passed most tests before it failed."""

    stage: int = -1
    text: str = ""

    def note(self, stage: int, text: str) -> None:
        """Keep a reason unless a later stage has given one."""
        if stage > self.stage:
            self.stage, self.text = stage, text


@dataclass(frozen=True)
class FlangeFace:
    """Hold a flange face with its plane, its edges, the visible share of the outer edge, and its quality.

    The edges' centres (2,) are in the plane's axes.
    """

    plane: PlaneFit
    outer: CircleFit
    bore: CircleFit | None
    coverage: float
    n_points: int
    quality: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceMeasurements:
    """Measurements that the tests of a flange use.

    Its plane and edges, the pitch between points m, the share of the outer edge seen, the points on the face, and the
    shares of the bore's core and of the ring between the edges that are face.
    """

    plane: PlaneFit
    outer: CircleFit
    bore: CircleFit | None
    pitch: float
    coverage: float
    count: int
    core_share: float
    ring_share: float
    bore_coverage: float = 1.0


def thickness(plane: PlaneFit) -> float:
    """Largest distance (m) of a face point from the plane."""
    return max(3.0 * plane.rms, 0.0002)


def faces_on_plane(
    points: Array,
    seed_point: Array,
    normal: Array,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: FaceRefusal,
) -> list[FlangeFace]:
    """Find flange faces on one plane (point and normal (3,)), among its connected parts of about the flange's size."""
    d = points - seed_point
    around = np.einsum("nk,nk->n", d, d) < (1.2 * standard.outer_m) ** 2
    try:
        plane = fit_plane(points[around], (seed_point, normal), tolerance=3.0 * config.hypothesis_tolerance_m)
    except PlaneFitError as e:
        refusal.note(1, str(e))
        return []
    if plane.rms > config.max_plane_rms_m:
        refusal.note(1, f"The face is not flat: {1e3 * plane.rms:.2f} mm rms from its plane.")
        return []
    xy, pitch, part = _parts(points, plane, seed_point, 2.0 * standard.outer_m)
    if len(xy) < config.min_points:
        refusal.note(1, f"Only {len(xy)} points lie on the largest flat face; the flange needs {config.min_points}.")
        return []
    faces = []
    for k in range(min(3, int(part.max()) + 1)):
        mine = xy[part == k]
        if len(mine) < config.min_points // 2:
            break
        outer = _first_circle(mine, pitch, standard, config, refusal)
        if outer is None:
            continue
        center = plane.point + np.column_stack(plane_axes(plane.normal)) @ outer.center
        close = near(points, center, 0.68 * standard.outer_m + 3.0 * pitch)
        face = _measure(close, plane, outer, pitch, standard, config, refusal)
        if face is not None:
            faces.append(face)
    return faces


def edge_bounds(pitch: float, standard: FlangeStandard, config: FlangeFitConfig) -> tuple[float, float]:
    """Smallest and largest radius (m) accepted for the outer edge: from flat face to cylinder, with slack."""
    slack = max(config.radius_tolerance * standard.outer_radius_m, 1.5 * pitch)
    return standard.face_outer_radius_m - slack, standard.outer_radius_m + slack


def _first_circle(
    part: Array, pitch: float, standard: FlangeStandard, config: FlangeFitConfig, refusal: FaceRefusal
) -> CircleFit | None:
    """Return the outer edge of a connected part (N, 2), roughly."""
    bounds = edge_bounds(pitch, standard, config)
    extent = float(np.ptp(part, axis=0).max())
    wanted = f"the flange has {1e3 * standard.outer_m:.0f} mm"
    if extent < bounds[0]:
        refusal.note(2, f"The largest flat face is {1e3 * extent:.3g} mm across; {wanted}.")
        return None
    if extent > _WIDEST * standard.outer_m:
        refusal.note(2, f"The flat faces found are {1e3 * extent:.3g} mm across and more; {wanted}.")
        return None
    middle = 0.5 * (part.min(axis=0) + part.max(axis=0))
    band = (0.3 * standard.outer_radius_m, 4.0 * standard.outer_radius_m)
    rim = sector_edges(part, middle, pitch, outer=True, band=band)
    try:
        return fit_circle(rim, radius_bounds=bounds, noise_floor=0.2 * pitch, hypotheses=100, seed=config.seed)
    except CircleFitError:
        refusal.note(
            3, f"The flat face is {1e3 * extent:.3g} mm across and has no circular edge of that size; {wanted}."
        )
        return None


def _measure(
    points: Array,
    plane: PlaneFit,
    outer: CircleFit,
    pitch: float,
    standard: FlangeStandard,
    config: FlangeFitConfig,
    refusal: FaceRefusal,
) -> FlangeFace | None:
    """Plane and edges in turn, twice; then the tests."""
    bounds = edge_bounds(pitch, standard, config)
    slack = bounds[1] - standard.outer_radius_m
    bore: CircleFit | None = None
    xy, count = np.zeros((0, 2)), 0
    for _ in range(2):
        center3 = plane.point + np.column_stack(plane_axes(plane.normal)) @ outer.center
        inner = standard.bore_radius_m if bore is None else bore.radius
        ring = _between(
            points - center3,
            plane.normal,
            inner + _margin(pitch, outer.radius - inner),
            outer.radius - _margin(pitch, outer.radius - inner),
            2.0 * thickness(plane),
        )
        try:
            plane = fit_plane(points[ring], (plane.point, plane.normal), tolerance=2.0 * thickness(plane))
            count = int(ring.sum())
            center = (center3 - plane.point) @ np.column_stack(plane_axes(plane.normal))
            xy = _on_plane(points, plane, center3, 0.7 * standard.outer_m)
            outer = _edge(xy, center, outer.radius, pitch, outer=True)
        except (PlaneFitError, CircleFitError) as e:
            refusal.note(4, str(e))
            return None
        try:
            radius = standard.face_inner_radius_m if bore is None else bore.radius
            bore = _edge(xy, outer.center, radius, pitch, outer=False)
        except CircleFitError:
            bore = None
        if bore is not None and (
            abs(bore.radius - standard.face_inner_radius_m) > slack + standard.chamfer_m
            or float(np.linalg.norm(bore.center - outer.center)) > 0.25 * slack + pitch
        ):
            bore = None
    rho = np.linalg.norm(xy - outer.center, axis=1)
    density = count / (outer.radius**2 - standard.bore_radius_m**2)
    core = 0.7 * standard.bore_radius_m
    span = (standard.face_inner_radius_m + 0.5 * pitch, outer.radius - 0.5 * pitch)
    middle = (span[0] + 0.75 * (span[1] - span[0]), span[1])  # where every ring of the size has its face
    full = np.count_nonzero((rho > middle[0]) & (rho < middle[1])) / (middle[1] ** 2 - middle[0] ** 2)
    measured = FaceMeasurements(
        plane=plane,
        outer=outer,
        bore=bore,
        pitch=pitch,
        coverage=coverage(xy[np.abs(rho - outer.radius) < 2.0 * pitch + 0.0005], outer.center),
        count=count,
        core_share=int((rho < core).sum()) / core**2 / max(density, 1e-9),
        bore_coverage=(
            0.0 if bore is None else coverage(xy[np.abs(rho - bore.radius) < 2.0 * pitch + 0.0005], outer.center)
        ),
        ring_share=np.count_nonzero((rho > span[0]) & (rho < span[1]))
        / (span[1] ** 2 - span[0] ** 2)
        / max(full, 1e-9),
    )
    return judge(measured, standard, config, refusal)


def _margin(pitch: float, width: float) -> float:
    """How far (m) from its edges a face ``width`` wide is taken for the plane.

    Points within a pixel of an edge are mixed with what lies behind it, and with 0.5 mm of noise they are not told from
    the face.
    """
    return min(_MIXED * pitch, _MOST_MIXED * width)


def _between(d: Array, normal: Array, inner: float, outer: float, height: float) -> NDArray[np.bool_]:
    h = d @ normal
    rho2 = np.einsum("nk,nk->n", d, d) - h * h
    return np.asarray((rho2 < outer**2) & (rho2 > inner**2) & (np.abs(h) < height))


def clear_band(standard: FlangeStandard, pitch: float, outer: bool) -> float:
    """Half width (m) of the ring about an edge that holds no screw hole."""
    gaps = [
        (
            standard.face_outer_radius_m - np.hypot(x, y) - r
            if outer
            else np.hypot(x, y) - r - standard.face_inner_radius_m
        )
        for x, y, r in standard.openings()
    ]
    return float(max(min([2.5 * pitch, *gaps]), 1.2 * pitch))


def lowered_by(beyond: Array, height: float, chamfer: float) -> float:
    """How far below its plane (m) a face ``height`` thick ends at an edge, from the heights (N,) past the edge.

    Where a chamfer continues the face, the face "ends" one thickness below its plane, and a slanting ray moves that
    sideways. Away from the scanner a chamfer is foreshortened below a pixel, so the edge is judged as a whole. A rough
    face is thicker than the ``chamfer`` (m) is deep: it ends with it, and on the side that shows its wall one thickness
    below the plane (docs/flange.md).
    """
    beyond = beyond[np.isfinite(beyond)]
    # what is past the edge lies lower than the thickness: where that is much, chamfer and wall are looked for deeper
    deepest = max(_CHAMFER_M, 2.0 * height)
    share = float(np.mean((beyond < 0.0) & (beyond > -deepest))) if len(beyond) else 0.0
    goes_on = share > _CHAMFER_SHARE
    if height <= chamfer:
        return height if goes_on else 0.0
    half = 0.5 * (height - chamfer)
    return chamfer + half + min(half, _HIDDEN_LESS * chamfer) if goes_on else chamfer


def _edge(xy: Array, center: Array, radius: float, pitch: float, *, outer: bool) -> CircleFit:
    """One edge near an expected circle. Raises CircleFitError where too little of it shows."""
    width = 2.0 * pitch + 0.0012
    found = sector_edges(xy, center, pitch, outer=outer, band=(radius - width, radius + width))
    return fit_circle(found, initial=(center, radius), noise_floor=0.1 * pitch)


def near(points: Array, center: Array, radius: float) -> Array:
    """Those of the points (N, 3) in a box about ``center`` (3,) with half-edge ``radius`` m."""
    return points[(np.abs(points - center) < radius).all(axis=1)]


def _on_plane(points: Array, plane: PlaneFit, center: Array, reach: float) -> Array:
    """Points on the face within ``reach`` of ``center``, in the plane's axes (N, 2)."""
    d = points - center
    flat = np.abs(d @ plane.normal - float((plane.point - center) @ plane.normal)) < thickness(plane)
    close = flat & (np.einsum("nk,nk->n", d, d) < reach**2)
    return np.asarray((points[close] - plane.point) @ np.column_stack(plane_axes(plane.normal)))


def _parts(points: Array, plane: PlaneFit, center: Array, reach: float) -> tuple[Array, float, NDArray[np.intp]]:
    """Return the face points (N, 2), the pitch between them (m), and the connected part each belongs to, largest 0."""
    xy = _on_plane(points, plane, center, reach)
    if len(xy) < 6:
        return xy, 1e-3, np.zeros(len(xy), dtype=np.intp)
    few = xy[:: max(1, len(xy) // 200)]
    # the 4th neighbour on a square grid is one pitch away; less sensitive to doubled points than the 1st
    pitch = float(np.median(np.asarray(cKDTree(xy).query(few, k=5)[0])[:, -1]))
    return xy, pitch, connected_parts(xy, 2.5 * pitch)


def judge(
    m: FaceMeasurements, standard: FlangeStandard, config: FlangeFitConfig, refusal: FaceRefusal
) -> FlangeFace | None:
    """Test size, edge and bore; return the face, or None with the reason noted."""
    bounds = edge_bounds(m.pitch, standard, config)
    rough = max(config.max_rim_rms_m, 0.7 * m.pitch)
    if not bounds[0] < m.outer.radius < bounds[1]:
        refusal.note(
            5,
            f"The circle found is {2e3 * m.outer.radius:.1f} mm across; the flange has"
            f" {1e3 * standard.outer_m:.0f} mm.",
        )
    elif m.count < config.min_points:
        refusal.note(5, f"Only {m.count} points lie on the face; the flange needs {config.min_points}.")
    elif m.coverage < config.min_coverage:
        refusal.note(
            6,
            f"Only {100 * m.coverage:.0f} % of the flange's edge was seen; {100 * config.min_coverage:.0f} % are"
            " needed.",
        )
    elif m.coverage < _ALONE and (m.bore is None or m.bore_coverage < _BORE_SEEN):
        refusal.note(
            6,
            f"Only {100 * m.coverage:.0f} % of the flange's edge was seen, and too little of its bore;"
            f" {100 * _ALONE:.0f} % are needed without it.",
        )
    elif m.coverage < _ALONE and m.bore is not None and not _concentric(m.outer, m.bore, m.pitch):
        refusal.note(6, "The part of an edge seen and the bore beside it are not concentric: it is not the flange.")
    elif m.outer.rms > rough:
        refusal.note(
            6,
            f"The edge is too rough: {1e3 * m.outer.rms:.2f} mm rms from its circle; at most {1e3 * rough:.2f} mm is "
            "allowed.",
        )
    elif m.core_share > _FILLED:
        refusal.note(6, f"The disc found has no bore of {1e3 * standard.bore_m:.1f} mm: it is not the flange.")
    elif m.ring_share < _least_ring(m):
        refusal.note(
            6,
            f"Only {100 * m.ring_share:.0f} % of the ring between the edge and a bore of {1e3 * standard.bore_m:.1f} mm"
            " is face: it is another ring, not the flange.",
        )
    else:
        quality = m.coverage + (1.0 if m.bore is not None else 0.0) - m.outer.rms / rough
        return FlangeFace(m.plane, m.outer, m.bore, m.coverage, m.count, quality)
    return None


def _least_ring(m: FaceMeasurements) -> float:
    """Return the share of the ring between the edges that must be face."""
    if m.bore is None:
        return _FULL
    return _SLOTTED if min(m.coverage, m.bore_coverage) > _ALL_ROUND else _HOLLOW


def _concentric(outer: CircleFit, bore: CircleFit, pitch: float) -> bool:
    """Return whether two circles share their centre, within four sigmas and 0.3 of a pixel."""
    spread = float(np.sqrt(np.trace(outer.covariance[:2, :2]) + np.trace(bore.covariance[:2, :2])))
    return float(np.hypot(*(outer.center - bore.center))) < 4.0 * spread + 0.3 * pitch
