"""Touches as an operator or a job records them: pose, tip and scanned feature, in touches.csv."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from weldcal.calibration.data.checks import check_reach, row_numbers, table_rows, unit_quaternion
from weldcal.calibration.data.clouds import read_cloud
from weldcal.calibration.data.scanner_correction import ScannerCorrection
from weldcal.calibration.errors import DatasetError
from weldcal.calibration.geometry.robust import MAD, TUKEY
from weldcal.models.arrays import Array
from weldcal.models.errors import InputError

POINT, PLANE, SPHERE, EDGE = "point", "plane", "sphere", "edge"
FEATURES = (POINT, PLANE, SPHERE, EDGE)
SIGMA_TIP_M = 5e-5  # a choice; the column sigma_tip sets another
"""Assumed standard deviation per axis of the tip's place on the flange, as a TCP is taught with care."""
SIGMA_RADIUS_M = 1e-5  # a choice: a diameter by caliper to 0.02 mm; the column sigma_radius sets another
"""Assumed standard deviation of the tip's radius."""
SIGMA_SCAN_M = 5e-5  # a choice: a fit to some hundred points; the column sigma_scan sets another
"""Assumed standard deviation of a feature in the scan, per axis."""

LEAST_POINTS = 30
_STEPS = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class Touch:
    """One touch.

    ``X_BF``: flange pose by the robot; ``p_FT`` (3,) m: centre of the tip's ball on the flange, ``radius`` m of that
    ball (0: a point). ``p_C`` (3,) m as the scanner gave it, not corrected: the point, a point of the plane or edge, or
    the sphere's centre. ``direction_C`` (3,): outward normal of a plane, direction of an edge, else None.
    ``feature_radius`` m of a sphere. ``q`` (n,) rad where known.
    """

    id: str
    feature: str
    X_BF: RigidTransform
    p_FT: Array
    radius: float
    p_C: Array
    direction_C: Array | None = None
    feature_radius: float = 0.0
    sigma_tip: float = SIGMA_TIP_M
    sigma_radius: float = SIGMA_RADIUS_M
    sigma_scan: float = SIGMA_SCAN_M
    q: Array | None = None

    @property
    def p_BT(self) -> Array:
        """The tip's centre in the base (3,) m, as the robot says."""
        return np.asarray(self.X_BF.multiply(self.p_FT))


def require_touches(touches: Sequence[Touch]) -> None:
    """Check touches that no file has checked. Raises InputError naming the touch."""
    if not touches:
        raise InputError("There are no touches: touch three points and more.")
    for t in touches:
        if t.feature not in FEATURES:
            raise InputError(
                f"Touch '{t.id}': the feature is {', '.join(FEATURES[:-1])} or {FEATURES[-1]}, not '{t.feature}'."
            )
        if t.feature in (PLANE, EDGE) and t.direction_C is None:
            what = "outward normal" if t.feature == PLANE else "direction"
            raise InputError(
                f"Touch '{t.id}': a touched {t.feature} needs its {what} (camera_nx, camera_ny, camera_nz)."
            )
        if t.feature == SPHERE and not t.feature_radius > 0.0:
            raise InputError(f"Touch '{t.id}': a touched sphere needs its radius (feature_radius, m).")


def around(points_C: Array, p_C: Array, within_m: float, name: str, least: int = LEAST_POINTS) -> Array:
    """Points (n, 3) m of a cloud at most ``within_m`` from a place (3,) m.

    Raises InputError for fewer than ``least``.
    """
    p = np.asarray(points_C, dtype=float).reshape(-1, 3)
    near: Array = p[np.linalg.norm(np.nan_to_num(p, nan=np.inf) - p_C, axis=1) <= within_m]
    if len(near) < least:
        raise InputError(
            f"Touch '{name}': the cloud has {len(near)} points within {1e3 * within_m:.0f} mm of camera_x, camera_y,"
            f" camera_z, and {least} are needed. Correct the place, or raise `within`."
        )
    return np.asarray(near)


def fit_touched_plane(points_C: Array) -> tuple[Array, Array, float]:
    """Fit the plane through points (n, 3), its normal (3,) towards the camera.

    Returns a point (3,) m, the unit normal and the standard deviation (m).

    Total least squares with Tukey's weights, the scale from the median. The deviation is that of the plane's distance
    where the points are.
    """
    w = np.ones(len(points_C))
    middle, n, scale = points_C.mean(axis=0), np.zeros(3), 0.0
    for _ in range(_STEPS):
        middle = w @ points_C / w.sum()
        away = points_C - middle
        n = np.linalg.eigh((away * w[:, None]).T @ away)[1][:, 0]
        e = away @ n
        scale = max(MAD * float(np.median(np.abs(e))), 1e-7)
        w = np.maximum(1.0 - (e / (TUKEY * scale)) ** 2, 0.0) ** 2
    return middle, n if n @ middle < 0.0 else -n, scale / float(np.sqrt(w.sum()))


def fit_touched_sphere(
    points_C: Array, radius_m: float, correction: ScannerCorrection | None = None
) -> tuple[Array, float]:
    """Fit a sphere of known radius through points (n, 3) of its near side.

    Returns its centre (3,) m, as the scanner gives it, and its standard deviation (m).

    Gauss-Newton on distances with Tukey's weights; the points are corrected first, because the radius is the true one,
    and the centre is returned uncorrected. The deviation is the largest of the three axes.
    """
    p = points_C if correction is None else correction.points(points_C)
    middle = p.mean(axis=0)
    c = middle + radius_m * middle / np.linalg.norm(middle)  # behind what is seen
    w, scale, N = np.ones(len(p)), 1.0, np.eye(3)
    for _ in range(_STEPS):
        v = p - c
        d = np.linalg.norm(v, axis=1)
        e, J = d - radius_m, -v / d[:, None]
        scale = max(MAD * float(np.median(np.abs(e))), 1e-7)
        w = np.maximum(1.0 - (e / (TUKEY * scale)) ** 2, 0.0) ** 2
        N = (J * w[:, None]).T @ J
        c = c - np.linalg.solve(N + 1e-9 * np.eye(3), (J * w[:, None]).T @ e)
    sigma = scale * float(np.sqrt(1.0 / max(np.linalg.eigvalsh(N)[0], 1e-9)))
    if correction is None:
        return c, sigma
    raw = c.copy()
    for _ in range(_STEPS):  # the correction is nearly the identity: a fixed point
        raw = raw + (c - correction.points(raw))
    return raw, sigma


POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
TIP = ("tip_x", "tip_y", "tip_z", "tip_radius")
CAMERA = ("camera_x", "camera_y", "camera_z")
DIRECTION = ("camera_nx", "camera_ny", "camera_nz")
REQUIRED = ("id", "feature", *POSE, *TIP, *CAMERA)
_WITHIN_M = 0.01  # a choice: the points of a ball of 20 mm; the column "within" sets another
_LONGEST_TIP_M = 2.0  # a choice: longer than any tool, shorter than millimetres that are called metres
_LARGEST_RADIUS_M = 0.2  # a choice: larger than any ball, smaller than millimetres that are called metres


def read_touches(path: Path, correction: ScannerCorrection | None = None) -> tuple[Touch, ...]:
    """Return the touches of a table; ``correction`` is the result's, for spheres that are fitted to a cloud.

    Raises:
        InputError: the file, a cell or a cloud cannot be used: one sentence with the row and what to change.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f"There is no file '{path}' of touches: give a CSV with the columns {','.join(REQUIRED)}.")
    rows = table_rows(path, REQUIRED)
    touches = tuple(_touch(row, path, correction) for row in rows)
    check_reach(np.array([t.X_BF.translation() for t in touches]), path, "m")
    check_reach(np.array([t.p_C for t in touches]), path, "m", "scanner")
    require_touches(touches)
    return touches


def touches_text(touches: Sequence[Touch]) -> str:
    """Return the table of touches, which read_touches reads."""
    joints = max((len(t.q) for t in touches if t.q is not None), default=0)
    names = [*REQUIRED, *DIRECTION, "feature_radius", "sigma_tip", "sigma_radius", "sigma_scan"]
    names += [f"q{i + 1}" for i in range(joints)]
    lines = [",".join(names)]
    for t in touches:
        numbers = [*t.X_BF.translation(), *t.X_BF.rotation().ToQuaternion().wxyz(), *t.p_FT, t.radius, *t.p_C]
        direction = ["", "", ""] if t.direction_C is None else [repr(float(v)) for v in t.direction_C]
        own = [t.feature_radius, t.sigma_tip, t.sigma_radius, t.sigma_scan]
        q = [""] * joints if t.q is None else [repr(float(v)) for v in t.q]
        lines.append(
            ",".join(
                [t.id, t.feature, *(repr(float(v)) for v in numbers), *direction, *(repr(float(v)) for v in own), *q]
            )
        )
    return "\n".join(lines) + "\n"


def _touch(row: dict[str, str], path: Path, correction: ScannerCorrection | None) -> Touch:
    name, feature = row["id"], row["feature"].lower()
    if feature not in FEATURES:
        raise DatasetError(
            f"'{path.name}': the feature of '{name}' is '{row['feature'][:40]}'; write {', '.join(FEATURES[:-1])} or"
            f" {FEATURES[-1]}."
        )
    xyz, wxyz = np.split(np.array(row_numbers(row, POSE, path)), [3])
    *tip, radius = row_numbers(row, TIP, path)
    if float(np.linalg.norm(tip)) > _LONGEST_TIP_M or not 0.0 <= radius <= _LARGEST_RADIUS_M:
        raise DatasetError(
            f"'{path.name}': the tip of '{name}' must be in metres on the flange, with a radius from 0 to"
            f" {_LARGEST_RADIUS_M:g} m."
        )
    joints = tuple(sorted((c for c in row if re.fullmatch(r"q\d+", c) and row[c]), key=lambda c: int(c[1:])))
    touch = Touch(
        id=name,
        feature=feature,
        X_BF=RigidTransform(unit_quaternion(list(wxyz), name), xyz),
        p_FT=np.array(tip),
        radius=radius,
        p_C=np.array(row_numbers(row, CAMERA, path)),
        direction_C=_direction(row, path),
        feature_radius=_positive(row, "feature_radius", 0.0, path),
        sigma_tip=_positive(row, "sigma_tip", SIGMA_TIP_M, path),
        sigma_radius=_positive(row, "sigma_radius", SIGMA_RADIUS_M, path),
        sigma_scan=_positive(row, "sigma_scan", SIGMA_SCAN_M, path),
        q=np.array(row_numbers(row, joints, path)) if joints else None,
    )
    return touch if not row.get("cloud") else _fitted(touch, row, path, correction)


def _fitted(touch: Touch, row: dict[str, str], path: Path, correction: ScannerCorrection | None) -> Touch:
    """Return the touch with its plane or sphere from the row's cloud, around the place that the row gives."""
    if touch.feature in (POINT, EDGE):
        raise DatasetError(
            f"'{path.name}': a {touch.feature} ('{touch.id}') is not fitted to a cloud; give its place"
            + (
                " and direction (camera_nx, camera_ny, camera_nz)."
                if touch.feature == EDGE
                else ", and leave cloud empty."
            )
        )
    try:
        cloud = read_cloud(path.parent / row["cloud"])
    except InputError as problem:
        raise DatasetError(f"'{path.name}', touch '{touch.id}': {problem}") from problem
    near = around(cloud, touch.p_C, _positive(row, "within", _WITHIN_M, path), touch.id)
    given = row.get("sigma_scan")
    if touch.feature == PLANE:
        p, n, sigma = fit_touched_plane(near)
        return replace(touch, p_C=p, direction_C=n, sigma_scan=touch.sigma_scan if given else _no_less(sigma))
    if touch.feature == SPHERE and not touch.feature_radius > 0.0:
        raise DatasetError(
            f"'{path.name}': the sphere of '{touch.id}' needs its radius in the column feature_radius (m)."
        )
    c, sigma = fit_touched_sphere(near, touch.feature_radius, correction)
    return replace(touch, p_C=c, sigma_scan=touch.sigma_scan if given else _no_less(sigma))


def _no_less(sigma: float) -> float:
    """Points of one scan err together: their mean is not known better than half of what is assumed without them."""
    return max(sigma, 0.5 * SIGMA_SCAN_M)


def _direction(row: dict[str, str], path: Path) -> Array | None:
    if not any(row.get(c) for c in DIRECTION):
        return None
    missing = [c for c in DIRECTION if not row.get(c)]
    if missing:
        raise DatasetError(f"'{path.name}': the direction of '{row['id']}' lacks {', '.join(missing)}.")
    n = np.array(row_numbers(row, DIRECTION, path))
    length = float(np.linalg.norm(n))
    if not abs(length - 1.0) < 1e-2:
        raise DatasetError(
            f"'{path.name}': the direction of '{row['id']}' has the length {length:.3f}; give a unit vector."
        )
    return n / length


def _positive(row: dict[str, str], column: str, otherwise: float, path: Path) -> float:
    if not row.get(column):
        return otherwise
    (value,) = row_numbers(row, (column,), path)
    if not 0.0 <= value < 1.0:
        raise DatasetError(
            f"'{path.name}': {column} of '{row['id']}' is {value:g}; it is a length in metres, from 0 to 1."
        )
    return value
