"""Measure the soft tip's displacement from an ArUco tag behind it, seen by the finger camera."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.errors import InputError
from weldcal.welding.finger.quality import LIMIT_SIGMAS, PictureQuality, picture_quality
from weldcal.welding.finger.sides import sides_of_square
from weldcal.welding.numerics import Array, pose

_DICTIONARIES = {
    "4X4_50": cv2.aruco.DICT_4X4_50,
    "4X4_100": cv2.aruco.DICT_4X4_100,
    "5X5_50": cv2.aruco.DICT_5X5_50,
    "6X6_50": cv2.aruco.DICT_6X6_50,
    "APRILTAG_36h11": cv2.aruco.DICT_APRILTAG_36h11,
}


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
    """What a detection must satisfy: reprojection error in px (rms), distance from the camera in m, and error in m.

    `lateral_m` and `depth_m` bound LIMIT_SIGMAS standard deviations of the position across and along the camera's axis.
    """

    max_reprojection_px: float = 1.0
    near_m: float = 0.005
    far_m: float = 1.0
    lateral_m: float = 5e-5  # a choice: a sixth of the weld's 0.3 mm
    depth_m: float = 2e-4  # a choice: depth is the tip's height, which the servo presses to 3 mm


@dataclass(frozen=True, eq=False, kw_only=True)
class TagObservation:
    """The result of one tag detection.

    Attributes:
        valid: whether `X_KM` can be used.
        reason: empty when valid, else one sentence.
        X_KM: pose of the tag in the finger camera, None when not valid.
        corners: (4,2) px, sub-pixel, centre of the first pixel at (0, 0); None when the tag was not seen.
        reprojection_px: rms distance of the corners from the model's, in px; infinite when not seen.
        covariance_K: (3,3) m^2, of the position of `X_KM` as the picture's quality lets expect; None without a pose.
        quality: sharpness, light and contrast; None without a pose.
    """

    valid: bool
    reason: str
    X_KM: RigidTransform | None = None
    corners: Array | None = None
    reprojection_px: float = float("inf")
    covariance_K: Array | None = None
    quality: PictureQuality | None = None


@lru_cache(maxsize=8)
def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(_DICTIONARIES[name])


def dictionary_named(name: str) -> Any:
    """OpenCV's dictionary of a name that TagModel takes. Raises TagError for another name."""
    if name not in _DICTIONARIES:
        raise TagError(f"Unknown tag dictionary '{name}'; use one of {', '.join(_DICTIONARIES)}.")
    return _dictionary(name)


@lru_cache(maxsize=8)
def _detector(name: str) -> Any:
    return cv2.aruco.ArucoDetector(_dictionary(name), cv2.aruco.DetectorParameters())


def _corners(grey: NDArray[np.uint8], tag: TagModel) -> list[Array]:
    """Corners (4, 2) px of each copy of the tag in the image."""
    found, ids, _ = _detector(tag.dictionary).detectMarkers(grey)
    if ids is None:
        return []
    return [
        np.asarray(c, dtype=float).reshape(4, 2) for c, i in zip(found, ids.ravel(), strict=True) if int(i) == tag.id
    ]


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
        distortion: OpenCV's coefficients, by which the picture is rectified first; None for none.

    Raises:
        TagError: the image or the camera matrix is invalid.
    """
    bounds = limits or TagLimits()
    K = np.asarray(camera_matrix, dtype=float)
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        raise TagError("The camera matrix must be a finite 3 x 3 array with positive focal lengths.")
    grey = _grey(image)
    if distortion is not None:  # sides and inner edges are straight in the rectified picture alone
        grey = np.asarray(cv2.undistort(grey, K, np.asarray(distortion, dtype=float)), dtype=np.uint8)
    hits = _corners(grey, tag)
    if not hits:
        return TagObservation(valid=False, reason=f"Tag {tag.id} is not visible to the finger camera.")
    if len(hits) > 1:
        return TagObservation(valid=False, reason=f"Tag {tag.id} is seen {len(hits)} times; it must be unique.")
    cells = tag_cells(tag)
    sides = sides_of_square(grey, hits[0], len(cells))
    if sides is None:
        text = (
            f"A side of tag {tag.id} is covered, out of the picture or without contrast; clean the window and the tag."
        )
        return TagObservation(valid=False, reason=text, corners=hits[0])
    corners = sides.corners

    _, rotations, translations, errors = cv2.solvePnPGeneric(
        tag.corners_M, corners, K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    if not rotations:
        return TagObservation(valid=False, reason=f"No pose explains the corners of tag {tag.id}.", corners=corners)
    spread = np.nan_to_num(np.asarray(errors, dtype=float).ravel(), nan=np.inf)
    best = int(np.argmin(spread))
    if spread[best] > bounds.max_reprojection_px:
        # Square to the camera to the last pixel, the closed form divides by zero; the iterative one does not.
        _, start_r, start_p = cv2.solvePnP(tag.corners_M, corners, K, None, flags=cv2.SOLVEPNP_ITERATIVE)
    else:
        start_r, start_p = rotations[best], translations[best]
    r, p = cv2.solvePnPRefineLM(tag.corners_M, corners, K, None, start_r.copy(), start_p.copy())
    predicted, _ = cv2.projectPoints(tag.corners_M, r, p, K, None)
    gaps = np.linalg.norm(predicted.reshape(4, 2) - corners, axis=1)
    error = float(np.sqrt(np.mean(gaps**2)))
    position = np.asarray(p, dtype=float).reshape(3)
    if not (np.isfinite(position).all() and np.isfinite(r).all()) or error > bounds.max_reprojection_px:
        text = (
            f"The corners of tag {tag.id} are {error:.2f} px from any pose; clean the tag or check the camera matrix."
        )
        return TagObservation(valid=False, reason=text, corners=corners, reprojection_px=error)
    distance = float(np.linalg.norm(position))
    if position[2] <= 0.0 or not bounds.near_m <= distance <= bounds.far_m:
        text = f"Tag {tag.id} seems {1e3 * distance:.1f} mm away, out of its range; check the tag's size."
        return TagObservation(valid=False, reason=text, corners=corners, reprojection_px=error)
    quality = picture_quality(grey, sides, cells, error)
    covariance = quality.covariance(position, tag.size_m, K)
    lateral, depth = LIMIT_SIGMAS * np.sqrt([np.linalg.eigvalsh(covariance[:2, :2])[1], covariance[2, 2]])
    if quality.blurred or lateral > bounds.lateral_m or depth > bounds.depth_m:
        text = f"The picture of tag {tag.id} is not sharp and even enough to measure: {quality.cause()}"
        return TagObservation(
            valid=False, reason=text, corners=corners, reprojection_px=error, covariance_K=covariance, quality=quality
        )
    X_KM = pose(cv2.Rodrigues(r)[0], position)
    return TagObservation(
        valid=True,
        reason="",
        X_KM=X_KM,
        corners=corners,
        reprojection_px=error,
        covariance_K=covariance,
        quality=quality,
    )


def deflection_from_tag(X_KM: RigidTransform, X_KM_rest: RigidTransform, R_TK: RotationMatrix) -> Array:
    """The tip's displacement from rest, p_T(tip) - p_T(rest), (3,) m in the tip frame T.

    The paper's delta (Eq. 15) is P_r - P_s: the negative of this, turned into the base.

    Args:
        X_KM: the tag now; X_KM_rest: the tag with the tip free.
        R_TK: orientation of the finger camera in T.
    """
    return np.asarray(R_TK.matrix() @ (np.asarray(X_KM.translation()) - np.asarray(X_KM_rest.translation())))
