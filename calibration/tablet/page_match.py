"""Compares touches with the landmarks they belong to, and names the mistake in the file where they contradict each
other."""

from collections.abc import Sequence
from itertools import product

import numpy as np

from weldcal.calibration.errors import TabletDataError
from weldcal.models.arrays import Array

_NEAREST = 0.5  # of the landmarks' least distance: a touch farther from its landmark may be nearer to another
_BETTER = 0.4  # what a changed reading must leave of the distances to be named, as in the other diagnostics
_SAME_LENGTH = 0.02  # of a ratio of lengths that is named as a unit


def check_page_match(
    touched_px: Array, landmark_px: Array, names: Sequence[str], mm_per_px: float, file: str
) -> tuple[str, ...]:
    """Require that touches (n, 2) px lie at their landmarks (n, 2) px; sentences on single ones that do not.

    A touch belongs to the landmark that is nearest, so it may miss by half of the least distance of two landmarks: that
    is 30 times the scatter of a person's aim on the usual page. Fit and report do not show a mistake here: touches
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
    """The factor that brings the touches' extent to the landmarks', any shift left open."""
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
