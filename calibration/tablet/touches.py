"""The measurements of one tablet visit: pixels of the landmarks, hand positions, and touching errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import CollinearLandmarks, EqualRotations, TabletDataError, TooFewLandmarks
from weldcal.models.arrays import Array

MIN_LANDMARKS = 4
_THIN = 0.05  # the landmarks' narrow spread as a share of their long one, below which they count as a line
_LEAST_TURN_RAD = np.radians(5.0)  # spread of the hand's turns (rms) that still separates pen and camera


@dataclass(frozen=True, kw_only=True)
class TabletTouches:
    """Planar touches with an upright pen, one row per landmark; the hand turns about its own downward z only.

    ``uv_px`` (n, 2) landmark in the image, ``depth_m`` (n,) along the optical axis, ``hand_m`` (n, 2) hand in the base
    when the pen touched, ``theta_rad`` (n,) turn of the hand then, ``delta_px`` (n, 2) landmark minus touched point on
    the tablet, ``landmark_px`` (n, 2) landmark on the tablet. ``pitch_m`` metres per tablet pixel; ``focal_px`` (2,)
    and ``centre_px`` (2,) of the camera; ``hand_capture_m`` (3,) hand in the base when the image was taken (turn 0).
    The hand at turn 0 has x along -x of the base and z down (Eq. 1: Ry(180)).
    """

    uv_px: Array
    depth_m: Array
    hand_m: Array
    theta_rad: Array
    delta_px: Array
    landmark_px: Array
    pitch_m: float
    focal_px: Array
    centre_px: Array
    hand_capture_m: Array

    def __post_init__(self) -> None:
        """Refuse shapes that do not fit and numbers that are none (TabletDataError)."""
        n = len(self.uv_px)
        shapes = {
            "uv_px": (n, 2),
            "depth_m": (n,),
            "hand_m": (n, 2),
            "theta_rad": (n,),
            "delta_px": (n, 2),
            "landmark_px": (n, 2),
            "focal_px": (2,),
            "centre_px": (2,),
            "hand_capture_m": (3,),
        }
        for name, shape in shapes.items():
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise TabletDataError(f"'{name}' must have the shape {shape}, and it has {value.shape}.")
            if not np.isfinite(value).all():
                raise TabletDataError(f"'{name}' holds a value that is not finite; remove that landmark.")
            object.__setattr__(self, name, value)
        if not (np.isfinite(self.pitch_m) and self.pitch_m > 0.0):
            raise TabletDataError("The tablet's pixel pitch must be positive; check its pixels per inch.")
        if not (self.depth_m > 0.0).all():
            raise TabletDataError("A depth is not positive; depths are measured along the optical axis, in front.")

    @property
    def rays(self) -> Array:
        """Viewing rays (n, 2) of the landmarks at depth 1 (Eq. 4)."""
        return (self.uv_px - self.centre_px) / self.focal_px

    @property
    def landmark_m(self) -> Array:
        """Landmarks on the tablet (n, 2) m (Eq. 9)."""
        return self.pitch_m * self.landmark_px

    @property
    def touched_m(self) -> Array:
        """Where the pen touched the tablet (n, 2) m."""
        return self.pitch_m * (self.landmark_px - self.delta_px)

    def pick(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> TabletTouches:
        """The same visit with these landmarks only."""
        rows = {
            f: getattr(self, f)[keep] for f in ("uv_px", "depth_m", "hand_m", "theta_rad", "delta_px", "landmark_px")
        }
        return TabletTouches(
            **rows,
            pitch_m=self.pitch_m,
            focal_px=self.focal_px,
            centre_px=self.centre_px,
            hand_capture_m=self.hand_capture_m,
        )


def check_touches(touches: TabletTouches) -> None:
    """Refuse touches that do not fix camera and pen.

    Raises TooFewLandmarks (< 4), CollinearLandmarks, and EqualRotations (with equal turns the pen's offset and the
    camera's translation only appear as their sum).
    """
    check_layout(touches.landmark_px)
    check_turns(touches.theta_rad)


def check_layout(landmarks: Array) -> None:
    """Raise TooFewLandmarks or CollinearLandmarks for landmarks (n, 2) in any unit."""
    n = int(same_landmark(landmarks).max(initial=-1)) + 1
    if n < MIN_LANDMARKS:
        raise TooFewLandmarks(
            f"{n} landmarks are too few{' (a landmark counts once)' if n < len(landmarks) else ''}; touch at least"
            f" {MIN_LANDMARKS}, better all nine."
        )
    spread = np.linalg.svd(landmarks - landmarks.mean(axis=0), compute_uv=False)
    if spread[1] <= _THIN * spread[0]:
        raise CollinearLandmarks("All landmarks lie on one line; touch landmarks that span an area.")


def same_landmark(landmarks: Array) -> NDArray[np.int64]:
    """A number (n,) from 0 for each of the landmarks (n, 2), the same for touches of the same one."""
    if len(landmarks) == 0:
        return np.zeros(0, dtype=np.int64)
    extent = max(float(np.ptp(landmarks, axis=0).max()), 1e-12)
    return np.unique(np.round(landmarks / extent, 6), axis=0, return_inverse=True)[1].ravel()


def check_turns(theta_rad: Array) -> None:
    """Raise EqualRotations for turns (n,) rad that are nearly all alike."""
    mean = np.exp(1j * theta_rad).mean()
    if np.sqrt(max(1.0 - abs(mean) ** 2, 0.0)) < _LEAST_TURN_RAD:
        raise EqualRotations(
            "The hand's rotation is nearly the same at every touch, so pen and camera cannot be separated; turn the"
            " last joint between touches, by 90 deg or more in all."
        )
