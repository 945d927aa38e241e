"""The measurements of one tablet visit, and the mistakes that touches and landmarks show in each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from weldcal.calibration.errors import CollinearLandmarks, EqualRotations, TabletDataError, TooFewLandmarks
from weldcal.models.arrays import Array

MIN_LANDMARKS = 4
_THIN = 0.05  # the landmarks' narrow spread as a share of their long one, below which they count as a line
_LEAST_TURN_RAD = np.radians(5.0)  # spread of the hand's turns (rms) that still separates pen and camera

_NEAREST = 0.5  # of the landmarks' least distance: a touch farther from its landmark may be nearer to another
_BETTER = 0.4  # what a changed reading must leave of the distances to be named, as in the other diagnostics
_SAME_LENGTH = 0.02  # of a ratio of lengths that is named as a unit


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
        """Return the same visit with these landmarks only."""
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
    """Return a number (n,) from 0 for each of the landmarks (n, 2), the same for touches of the same one."""
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


def check_page_match(
    touched_px: Array, landmark_px: Array, names: Sequence[str], mm_per_px: float, file: str
) -> tuple[str, ...]:
    """Require that touches (n, 2) px lie at their landmarks (n, 2) px; sentences on single ones that do not.

    A touch belongs to the landmark that is nearest, so it may miss by half of the least distance of two landmarks: that
    is 30 times the scatter of an operator's aim on the usual page. Fit and report do not show a mistake here: touches
    alone fit a page that is mirrored or shifted just as well, and the camera is then off by as much.

    Raises:
        TabletDataError: a changed reading of the touches (axes swapped or mirrored, another unit, another origin,
            another order) explains them, or most of them lie elsewhere.
    """
    gap = _least_distance(landmark_px)
    off = np.linalg.norm(touched_px - landmark_px, axis=1)
    far = off > _NEAREST * gap
    if not far.any():
        return ()
    worst = int(off.argmax())
    told = (
        f"'{file}' contradicts itself: landmark {names[worst]} was touched {mm_per_px * off[worst]:.0f} mm from its"
        " place on the page"
    )
    cause = _changed_reading(touched_px, landmark_px, mm_per_px, gap) or _other_order(
        touched_px, landmark_px, names, gap
    )
    if cause is not None:
        raise TabletDataError(f"{told}, because {cause}. Correct the file.")
    if 2 * int(far.sum()) > len(far):
        raise TabletDataError(
            f"{told}, and so were {int(far.sum()) - 1} others. Check that touches and landmarks are of one page and in"
            " one unit."
        )
    which = ", ".join(name for name, f in zip(names, far, strict=True) if f)
    return (
        (
            f"Touched nearer to another landmark than to its own (up to {mm_per_px * off[worst]:.0f} mm away): landmark"
            f" {which}. Check its number in the file."
        ),
    )


def _least_distance(points: Array) -> float:
    """Least distance of two points that are not the same; 0 where all are."""
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    apart = d[d > 1e-6 * max(float(d.max()), 1e-12)]
    return float(apart.min()) if apart.size else 0.0


def _changed_reading(touched: Array, landmark: Array, mm_per_px: float, gap: float) -> str | None:
    """What was done to the touches' numbers, where undoing it brings all of them to their landmarks."""
    now = float(np.sqrt(((touched - landmark) ** 2).sum(axis=1).mean()))
    # fewest changes first: a symmetric page can be explained by more than one
    for free_scale, (swapped, flips) in product(
        (False, True), product((False, True), ((1, 1), (-1, 1), (1, -1), (-1, -1)))
    ):
        read = (touched[:, ::-1] if swapped else touched) * np.array(flips)
        scale = _scale(read, landmark) if free_scale else 1.0
        if scale <= 0.0:
            continue
        rest = scale * read - landmark
        rest = rest - rest.mean(axis=0) if flips != (1, 1) or free_scale or not swapped else rest
        left = np.linalg.norm(rest, axis=1)
        if left.max() < _NEAREST * gap and np.sqrt((left**2).mean()) < _BETTER * now:
            return _said(swapped, flips, scale, mm_per_px, mm_per_px * (touched - landmark).mean(axis=0))
    return None


def _scale(read: Array, landmark: Array) -> float:
    """Return the factor that brings the touches' extent to the landmarks', any shift left open."""
    a, b = read - read.mean(axis=0), landmark - landmark.mean(axis=0)
    return float((a * b).sum() / max(float((a * a).sum()), 1e-12))


def _said(swapped: bool, flips: tuple[int, int], scale: float, mm_per_px: float, shift_mm: Array) -> str:
    causes = []
    if swapped and flips == (1, 1):
        causes.append("touch_x and touch_y are swapped")
    elif swapped:
        causes.append(
            "the touches' axes are turned by 90 deg against the landmarks'"
            if flips[0] != flips[1]
            else "touch_x and touch_y are swapped and both mirrored"
        )
    elif flips != (1, 1):
        which = " and ".join(n for n, f in zip(("touch_x", "touch_y"), flips, strict=True) if f < 0)
        causes.append(
            f"{which} {'are' if flips == (-1, -1) else 'is'} mirrored (counted from the other side of the page)"
        )
    if scale != 1.0:
        size = 1.0 / scale
        if abs(size / mm_per_px - 1.0) < _SAME_LENGTH:
            causes.append("the touches are in millimetres and the landmarks in pixels")
        elif abs(size * mm_per_px - 1.0) < _SAME_LENGTH:
            causes.append("the landmarks are in millimetres and the touches in pixels")
        else:
            causes.append(f"the touches are in another unit ({size:.3g} times the landmarks', as device pixels are)")
    if not causes:
        causes.append(
            f"all touches are shifted by ({shift_mm[0]:.1f}, {shift_mm[1]:.1f}) mm: they count from another origin"
        )
    return " and ".join(causes)


def _other_order(touched: Array, landmark: Array, names: Sequence[str], gap: float) -> str | None:
    """Touches that lie on landmarks, each on one of its own, but not on those of their numbers."""
    d = np.linalg.norm(touched[:, None] - landmark[None], axis=2)
    nearest = d.argmin(axis=1)
    moved = nearest != np.arange(len(nearest))
    if (
        (d.min(axis=1) > _NEAREST * gap).any()
        or len(set(nearest.tolist())) < len(nearest)
        or 2 * moved.sum() <= len(moved)
    ):
        return None
    k = int(moved.argmax())
    return f"the touches have another order than the landmarks (touch {names[k]} lies on landmark {names[nearest[k]]})"
