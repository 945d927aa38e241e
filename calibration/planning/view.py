"""Field of view, working distance and largest viewing angle of a camera."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.models.arrays import Array
from weldcal.models.scanners import ScannerPreset

Flags = NDArray[np.bool_]

_MARGIN = 0.85  # of the half picture: a board is more than its origin
_WIDER = 1.15  # than what was seen: as far as a sentence may go without knowing the camera
_STEEPEST_RAD = float(np.radians(60.0))


@dataclass(frozen=True)
class View:
    """Visible volume. ``tan_x``, ``tan_y``: half field of view; ``near``, ``far``: along the optical axis, in the unit of the data; ``tilt_rad``:
    largest angle between the target's normal and the line of sight; ``source``: its description for messages."""

    tan_x: float
    tan_y: float
    near: float
    far: float
    tilt_rad: float
    source: str

    def sees(self, G: Array) -> Flags:
        """Which targets (n, 4, 4) in the camera are visible."""
        p = G[:, :3, 3]
        z = np.maximum(p[:, 2], 1e-12)
        inside = (np.abs(p[:, 0]) <= self.tan_x * z) & (np.abs(p[:, 1]) <= self.tan_y * z)
        return np.asarray(inside & (p[:, 2] >= self.near) & (p[:, 2] <= self.far) & (tilt(G) <= self.tilt_rad))


def tilt(G: Array) -> Array:
    """Angles (n,) rad between the z axis of targets (n, 4, 4), whichever way it points, and the line of sight."""
    p = G[:, :3, 3]
    ray = p / np.maximum(np.linalg.norm(p, axis=1), 1e-12)[:, None]
    return np.asarray(np.arccos(np.clip(np.abs((ray * G[:, :3, 2]).sum(axis=1)), 0.0, 1.0)))


def view_of(seen: Array, K: Array | None = None, scanner: ScannerPreset | None = None) -> View:
    """View of a scanner preset, else of a camera matrix ``K`` (picture centred on its principal point), else of what was
    ``seen`` (n, 4, 4) so far, a little wider. Distances of a camera matrix are those seen, too."""
    steep = max(_STEEPEST_RAD, float(np.quantile(tilt(seen), 0.9)))
    if scanner is not None:
        wide = [min(c, size - 1 - c) / f for c, size, f in _axes(scanner)]
        return View(
            _MARGIN * wide[0],
            _MARGIN * wide[1],
            scanner.near_m,
            scanner.far_m,
            steep,
            f"the field of view of {scanner.name}",
        )
    z = seen[:, 2, 3]
    near, far = float(z.min()) / _WIDER, float(z.max()) * _WIDER
    if K is not None:
        tan = _MARGIN * K[0, 2] / K[0, 0], _MARGIN * K[1, 2] / K[1, 1]
        return View(float(tan[0]), float(tan[1]), near, far, steep, "the camera's picture and the distances so far")
    across = np.abs(seen[:, :2, 3]) / np.maximum(z, 1e-12)[:, None]
    x, y = (_WIDER * float(across[:, k].max()) for k in range(2))
    return View(x, y, near, far, steep, "where the target has been seen so far")


def _axes(scanner: ScannerPreset) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return (scanner.cx, float(scanner.width), scanner.fx), (scanner.cy, float(scanner.height), scanner.fy)
