"""Measures the soft tip's displacement from an ArUco tag behind it, seen by the finger camera."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.errors import InputError
from weldcal.welding.numerics import Array, pose

_DICTIONARIES = {
    "4X4_50": cv2.aruco.DICT_4X4_50,
    "4X4_100": cv2.aruco.DICT_4X4_100,
    "5X5_50": cv2.aruco.DICT_5X5_50,
    "6X6_50": cv2.aruco.DICT_6X6_50,
    "APRILTAG_36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
PROFILES = 48  # across each side
NEAR_CORNER = 0.06  # of a side, left out at either end: there the other side is in the profile
REACH = 0.3  # of a cell, on either side of the edge: further out other cells begin
STEP_PX = 0.5  # between the samples of a profile
LEAST_CONTRAST = 20.0  # grey levels between print and margin
ROUNDS = 2  # the second begins within a hundredth of a pixel of the end
_ALONG = np.linspace(NEAR_CORNER, 1.0 - NEAR_CORNER, PROFILES)
_NEXT, _BEFORE = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])  # of the sides


class TagError(InputError):
    """A tag, an image or a camera matrix that cannot be used as it is."""


@dataclass(frozen=True)
class TagModel:
    """The printed tag: its dictionary, its number and the length of its black side in m."""

    dictionary: str = "4X4_50"
    id: int = 0
    size_m: float = 0.010

    def __post_init__(self) -> None:
        if not 0 <= self.id < len(dictionary_named(self.dictionary).bytesList):
            raise TagError(f"Tag id {self.id} is not in dictionary {self.dictionary}.")
        if not (np.isfinite(self.size_m) and self.size_m > 0.0):
            raise TagError(f"The side of a tag must be a positive length in metres, not {self.size_m}.")

    @property
    def corners_M(self) -> Array:
        """The corners (4,3) m in the tag frame M (centre, x right, y up, z out of the print), in OpenCV's order."""
        h = 0.5 * self.size_m
        return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


@dataclass(frozen=True)
class TagLimits:
    """What a detection must satisfy: reprojection error in px (rms), and distance from the camera in m."""

    max_reprojection_px: float = 1.0
    near_m: float = 0.005
    far_m: float = 1.0


@dataclass(frozen=True)
class TagObservation:
    """The result of one tag detection.

    Attributes:
        valid: whether `X_KM` can be used.
        reason: empty when valid, else one sentence.
        X_KM: pose of the tag in the finger camera, None when not valid.
        corners: (4,2) px, sub-pixel, centre of the first pixel at (0, 0); None when the tag was not seen.
        reprojection_px: rms distance of the corners from the model's, in px; infinite when not seen.
    """

    valid: bool
    reason: str
    X_KM: RigidTransform | None = None
    corners: Array | None = None
    reprojection_px: float = float("inf")


@lru_cache(maxsize=8)
def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(_DICTIONARIES[name])


def dictionary_named(name: str) -> Any:
    """OpenCV's dictionary of a name that TagModel takes. Raises TagError for another name."""
    if name not in _DICTIONARIES:
        raise TagError(f"Unknown tag dictionary '{name}'; use one of {', '.join(_DICTIONARIES)}.")
    return _dictionary(name)


@lru_cache(maxsize=8)
def _detector(name: str, refine: bool) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    if refine:
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        # The window follows the tag's cell (0.3 of it, at most 5 px): a larger one sees neighbouring edges.
        parameters.cornerRefinementWinSize = 5
        parameters.relativeCornerRefinmentWinSize = 0.3
        parameters.cornerRefinementMaxIterations = 50
        parameters.cornerRefinementMinAccuracy = 0.005
    return cv2.aruco.ArucoDetector(_dictionary(name), parameters)


def _corners(grey: NDArray[np.uint8], tag: TagModel, refine: bool) -> list[Array]:
    """Corners (4, 2) px of each copy of the tag in the image."""
    found, ids, _ = _detector(tag.dictionary, refine).detectMarkers(grey)
    if ids is None:
        return []
    return [
        np.asarray(c, dtype=float).reshape(4, 2) for c, i in zip(found, ids.ravel(), strict=True) if int(i) == tag.id
    ]


def _sharpened(grey: NDArray[np.uint8], corners: Array, tag: TagModel) -> Array:
    """The corners from the tag's sides, or refined one by one where a side is covered or outside the image."""
    by_sides = corners_from_sides(grey, corners, int(_dictionary(tag.dictionary).markerSize) + 2)
    if by_sides is not None:
        return by_sides
    one_by_one = _corners(grey, tag, refine=True)
    return one_by_one[0] if one_by_one else corners


def tag_cells(tag: TagModel) -> NDArray[np.bool_]:
    """The print, cell by cell with its black border: (n+2, n+2), True is white, row 0 at the tag's top (+y of M)."""
    dictionary = _dictionary(tag.dictionary)
    n = int(dictionary.markerSize) + 2
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, tag.id, n, borderBits=1)) > 127


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    pixels = np.asarray(image)
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or pixels.size == 0:
        raise TagError("The finger camera image must be a (H, W) or (H, W, 3 or 4) array of uint8.")
    if pixels.ndim == 2:
        return np.ascontiguousarray(pixels)
    if pixels.shape[2] == 1:
        return np.ascontiguousarray(pixels[:, :, 0])
    if pixels.shape[2] == 3:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    if pixels.shape[2] == 4:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGBA2GRAY), dtype=np.uint8)
    raise TagError(f"The finger camera image has {pixels.shape[2]} channels; give 1, 3 or 4.")


def detect_tag(
    image: NDArray[np.uint8],
    camera_matrix: ArrayLike,
    tag: TagModel,
    limits: TagLimits | None = None,
    distortion: ArrayLike | None = None,
) -> TagObservation:
    """Find `tag` in one image and its pose in the camera.

    ArUco corners refined to a hundredth of a pixel by the tag's sides, IPPE for a square, then Levenberg-Marquardt on
    the reprojection. Two poses explain a tag that is nearly parallel to the image: their translation, which is all that
    `deflection_from_tag` uses, is the same.

    Args:
        image: (H,W) or (H,W,3|4) uint8, RGB(A).
        camera_matrix: (3,3), OpenCV's pixel convention.
        tag: what to look for.
        limits: what to refuse; TagLimits() when None.
        distortion: OpenCV's coefficients, None for none.

    Raises:
        TagError: the image or the camera matrix is invalid.
    """
    bounds = limits or TagLimits()
    K = np.asarray(camera_matrix, dtype=float)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        raise TagError("The camera matrix must be a finite 3 x 3 array with positive focal lengths.")
    lens = None if distortion is None else np.asarray(distortion, dtype=float)
    grey = _grey(image)
    hits = _corners(grey, tag, refine=False)
    if not hits:
        return TagObservation(False, f"Tag {tag.id} is not visible to the finger camera.")
    if len(hits) > 1:
        return TagObservation(False, f"Tag {tag.id} is seen {len(hits)} times; it must be unique.")
    corners = _sharpened(grey, hits[0], tag)

    _, rotations, translations, errors = cv2.solvePnPGeneric(
        tag.corners_M, corners, K, lens, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not rotations:
        return TagObservation(False, f"No pose explains the corners of tag {tag.id}.", None, corners)
    spread = np.nan_to_num(np.asarray(errors, dtype=float).ravel(), nan=np.inf)
    best = int(np.argmin(spread))
    if spread[best] > bounds.max_reprojection_px:
        # Square to the camera to the last pixel, the closed form divides by zero; the iterative one does not.
        _, start_r, start_p = cv2.solvePnP(tag.corners_M, corners, K, lens, flags=cv2.SOLVEPNP_ITERATIVE)
    else:
        start_r, start_p = rotations[best], translations[best]
    r, p = cv2.solvePnPRefineLM(tag.corners_M, corners, K, lens, start_r.copy(), start_p.copy())
    predicted, _ = cv2.projectPoints(tag.corners_M, r, p, K, lens)
    gaps = np.linalg.norm(predicted.reshape(4, 2) - corners, axis=1)
    error = float(np.sqrt(np.mean(gaps**2)))
    position = np.asarray(p, dtype=float).reshape(3)
    if not (np.isfinite(position).all() and np.isfinite(r).all()) or error > bounds.max_reprojection_px:
        text = (
            f"The corners of tag {tag.id} are {error:.2f} px from any pose; clean the tag or check the camera matrix."
        )
        return TagObservation(False, text, None, corners, error)
    distance = float(np.linalg.norm(position))
    if position[2] <= 0.0 or not bounds.near_m <= distance <= bounds.far_m:
        text = f"Tag {tag.id} seems {1e3 * distance:.1f} mm away, out of its range; check the tag's size."
        return TagObservation(False, text, None, corners, error)
    X_KM = pose(cv2.Rodrigues(r)[0], position)
    return TagObservation(True, "", X_KM, corners, error)


def deflection_from_tag(X_KM: RigidTransform, X_KM_rest: RigidTransform, R_TK: RotationMatrix) -> Array:
    """The tip's displacement from rest, p_T(tip) - p_T(rest), (3,) m in the tip frame T.

    The paper's delta (Eq. 15) is P_r - P_s: the negative of this, turned into the base.

    Args:
        X_KM: the tag now; X_KM_rest: the tag with the tip free.
        R_TK: orientation of the finger camera in T.
    """
    return np.asarray(R_TK.matrix() @ (np.asarray(X_KM.translation()) - np.asarray(X_KM_rest.translation())))


def corners_from_sides(grey: NDArray[np.uint8], corners: Array, cells: int) -> Array | None:
    """Locate the corners (4, 2) px of a black square on white as intersections of its sides.

    None where a side is not visible.

    Corner refinement looks at a few pixels round each corner, and where blur rounds the corner or the print differs on
    its two sides they move outwards: a tag of 112 px reads half a pixel too large, which is 0.2 mm in 40 mm of
    distance. Across a whole side the blur is symmetric: the total grey of a profile gives the position of its edge (the
    area under a blurred step equals that of the step, whatever the blur), averaged over a hundred pixels of a side.

    Args:
        grey: (H, W) uint8.
        corners: (4, 2) px, to a pixel or two, in order round the square; centre of the first pixel at (0, 0).
        cells: of the print along a side, its black border included.
    """
    found = np.asarray(corners, dtype=float)
    image = np.asarray(grey, dtype=np.float32)
    for _ in range(ROUNDS):
        ends = found[_NEXT]
        length = np.linalg.norm(ends - found, axis=1)
        if not np.isfinite(length).all() or length.min() < 4.0 * cells:
            return None
        tangent = (ends - found) / length[:, None]
        centre = found.mean(axis=0)
        outward = np.column_stack([tangent[:, 1], -tangent[:, 0]])
        outward *= np.sign(np.sum(outward * (0.5 * (found + ends) - centre), axis=1))[:, None]
        half = min(max(REACH * float(length.min()) / cells, 2.0), 6.0)
        n = 2 * int(np.ceil(half / STEP_PX)) + 1
        across = np.linspace(-half, half, n)
        middle = found[:, None] + _ALONG[None, :, None] * (ends - found)[:, None]
        x, y = (
            (middle[:, :, None, k] + across * outward[:, None, None, k]).reshape(4 * PROFILES, n).astype(np.float32)
            for k in (0, 1)
        )
        if x.min() < 0 or y.min() < 0 or x.max() > image.shape[1] - 1 or y.max() > image.shape[0] - 1:
            return None
        profiles = cv2.remap(image, x, y, cv2.INTER_LINEAR).reshape(4, PROFILES, n).astype(float)
        offset = _edge_offsets(profiles, across)
        if offset is None:
            return None
        lines = _lines(found, ends, outward, offset)
        previous = lines[_BEFORE]
        crossing = np.cross(previous, lines)
        if np.abs(crossing[:, 2]).min() < 1e-9:
            return None
        found = crossing[:, :2] / crossing[:, 2:]
    return np.asarray(found)


def _edge_offsets(profiles: Array, across: Array) -> Array | None:
    """Outward offset of each profile's edge, (4, PROFILES) px, from its dark share."""
    k = max(2, profiles.shape[2] // 5)
    dark, light = (_medians(part.reshape(4, -1)) for part in (profiles[:, :, :k], profiles[:, :, -k:]))
    if np.min(light - dark) < LEAST_CONTRAST:
        return None
    share = (light[:, None, None] - profiles) / (light - dark)[:, None, None]
    weights = np.full(len(across), across[1] - across[0])
    weights[[0, -1]] *= 0.5
    return np.asarray(share @ weights + across[0])


def _medians(rows: Array) -> Array:
    """Median of each row, an even number of numbers; `numpy.median` takes five times as long."""
    k = rows.shape[1] // 2
    middle = np.partition(rows, (k - 1, k), axis=1)[:, k - 1 : k + 1]
    return np.asarray(0.5 * (middle[:, 0] + middle[:, 1]))


def _lines(start: Array, end: Array, outward: Array, offset: Array) -> Array:
    """Homogeneous lines (4, 3) through the edge points of the sides; outliers (a scratch, a speck) are excluded."""
    weight = np.ones_like(offset)
    for _ in range(3):
        total = weight.sum(axis=1, keepdims=True)
        mean_t = weight @ _ALONG[:, None] / total
        mean_o = np.sum(weight * offset, axis=1, keepdims=True) / total
        t = _ALONG - mean_t
        slope = np.sum(weight * t * offset, axis=1, keepdims=True) / np.sum(weight * t * t, axis=1, keepdims=True)
        stray, before = np.abs(offset - mean_o - slope * t), weight
        weight = (stray <= np.maximum(4.5 * _medians(stray)[:, None], 0.02)).astype(float)
        if np.array_equal(weight, before):
            break
    at_start, at_end = mean_o - slope * mean_t, mean_o + slope * (1.0 - mean_t)
    a, b = start + at_start * outward, end + at_end * outward
    normal = np.column_stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]])
    return np.column_stack([normal, -np.sum(normal * a, axis=1)])
