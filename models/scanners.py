"""Supported 3D scanners: intrinsics, working range and noise, and their depth maps.

One pixel convention everywhere: OpenCV's, the centre of the first pixel at (0, 0). `drake_intrinsics` is the only place
that converts it to what Drake's camera wants.

Sources:

- PhoXi 3D Scanner S and M: working ranges, flange paper, section 3.2.1; images of 2064 x 1544 px. The S scans 343 mm at
  384 mm and 382 mm at 520 mm (Photoneo's figures in public view planners), so 360 mm at 442. The width of the M and the
  noise of both are choices; Photoneo's wiki defines the latter: the standard deviation on a surface of 80 % albedo.
- MotionCam-3D M: published resolutions. Its data sheet of 11/2020 has a temporal noise of 0.10 mm (dynamic mode). The
  0.25 and 0.5 mm in motion are choices on the safe side, and so are range and width.
- Azure Kinect: Microsoft's hardware specifications, depth mode NFOV unbinned: 640 x 576 px, 0.5 to 3.86 m. The focal
  length is that of a usual factory calibration; 1 mm at 1 m is a choice (the specification allows up to 17 mm).

One pixel of `_by_area` spans the scan width over the image's, and pixels are square.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from weldcal.models.depth_noise import Depth, DepthNoise, measured_points, noisy_depth
from weldcal.models.documents import did_you_mean, read_document, read_part
from weldcal.models.errors import InputError

if TYPE_CHECKING:
    from pydrake.math import RigidTransform

    from weldcal.models.mesh import TriMesh

LARGEST_PX = 8192


Floats = npt.NDArray[np.float64]


@dataclass(kw_only=True)
class NoisePart:
    """What differs from scan to scan."""

    sigma_mm: float = 0.1  # standard deviation of the depth on a bright surface seen head-on at optimum_mm
    growth: float = 2.0  # it grows as (distance / optimum)^growth: 2 for triangulation and for time of flight
    incidence: float = 1.0  # it grows as (1 / cos of the angle of incidence)^incidence
    correlation_px: float = 0.8  # neighbouring pixels err alike within this width
    edge_step_mm: float = 4.0  # neighbouring depths further apart than this are an edge
    flying: float = 0.05  # share of the pixels at an edge that read something between the two depths
    edge_dropout: float = 0.3  # share of the pixels at an edge that read nothing
    grazing_deg: float = 78.0  # surfaces seen at a larger angle of incidence are not measured
    dropout: float = 0.0005  # share of all pixels that read nothing
    dark_dropout: float = 0.9  # share of fully dark pixels that read nothing
    dark_gain: float = 3.0  # how much more a fully dark pixel errs
    quantum_mm: float = 0.0  # depths come in steps of this size; 0: continuous


@dataclass
class DistortionPart:
    """What stays the same from scan to scan in one device; calibrate estimates it with X_BC."""

    scale_error: float = 0.0  # relative error of all lengths
    gradient_error_per_m: tuple[float, float] = (0.0, 0.0)  # further relative error per metre of x and of y
    warp_mm: float = 0.0  # largest error of a smooth warp of the depth at optimum_mm


@dataclass(kw_only=True)
class ScannerPart:
    """A scanner file.

    Pixels as in OpenCV: the centre of the first pixel is (0, 0). fx, fy, cx, cy, or field_of_view_deg.
    """

    name: str = ""
    width: int = 0  # px
    height: int = 0
    fx: float = 0.0  # focal lengths, px
    fy: float = 0.0
    cx: float = math.nan  # principal point, px; left out: the middle of the picture
    cy: float = math.nan
    field_of_view_deg: float = 0.0  # horizontal, in place of fx and fy: square pixels
    near_mm: float = 0.0  # working range along the view
    far_mm: float = 0.0
    optimum_mm: float = 0.0  # where noise and distortion are stated; left out: the middle of the range
    noise: NoisePart = field(default_factory=NoisePart)
    distortion: DistortionPart = field(default_factory=DistortionPart)


@dataclass(frozen=True, kw_only=True)
class ScannerPreset:
    """A scanner: image size and intrinsics in pixels (OpenCV convention), working range in metres, and its noise."""

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    near_m: float
    far_m: float
    optimum_m: float
    noise: DepthNoise

    @property
    def K(self) -> Floats:
        """(3,3) OpenCV camera matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def footprint_m(self, distance_m: float) -> tuple[float, float]:
        """Width and height of the scanned area on a plane at that distance, m."""
        return self.width * distance_m / self.fx, self.height * distance_m / self.fy

    def measured(self, points_C: Floats) -> Floats:
        """Where the device's own errors, without noise, put points (..., 3) m of its camera frame."""
        return measured_points(points_C, self.noise, (self.fx, self.fy, self.cx, self.cy, self.width, self.height))

    def resized(self, width: int, height: int | None = None) -> ScannerPreset:
        """Return the same view in another resolution; the image corners, not the pixel centres, stay where they are."""
        height = round(self.height * width / self.width) if height is None else height
        if width < 8 or height < 8:
            raise InputError("A scanner image needs at least 8 x 8 pixels: ask for a larger width and height.")
        su, sv = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * su,
            fy=self.fy * sv,
            cx=(self.cx + 0.5) * su - 0.5,
            cy=(self.cy + 0.5) * sv - 0.5,
            noise=replace(self.noise, correlation_px=self.noise.correlation_px * su),
        )


def read_scanner_file(path: Path) -> ScannerPreset:
    """Return the scanner of a file.

    Raises:
        InputError: the file cannot be read, has an unknown key, or describes a scanner that cannot be.
    """
    if not path.is_file():
        raise InputError(f"There is no scanner file '{path}'.")
    return _read(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _read(path: Path, changed: int) -> ScannerPreset:
    part, file = read_part(ScannerPart, read_document(path), path.name), path.name
    if not (8 <= part.width <= LARGEST_PX and 8 <= part.height <= LARGEST_PX):
        raise InputError(
            f"'{file}': width and height must be from 8 to {LARGEST_PX} px, not {part.width} x {part.height}."
        )
    fx, fy = part.fx, part.fy
    if part.field_of_view_deg and (fx or fy):
        raise InputError(f"'{file}': give fx and fy, or field_of_view_deg, not both.")
    if part.field_of_view_deg:
        if not 0.0 < part.field_of_view_deg < 170.0:
            raise InputError(f"'{file}': field_of_view_deg must be from 0 to 170, not {part.field_of_view_deg:g}.")
        fx = fy = 0.5 * part.width / math.tan(math.radians(0.5 * part.field_of_view_deg))
    fy = fy or fx
    if not min(fx, fy) > 0.0:
        raise InputError(f"'{file}' needs fx (px), or field_of_view_deg.")
    cx = 0.5 * (part.width - 1) if math.isnan(part.cx) else part.cx
    cy = 0.5 * (part.height - 1) if math.isnan(part.cy) else part.cy
    if not (0.0 <= cx < part.width and 0.0 <= cy < part.height):
        raise InputError(f"'{file}': the principal point ({cx:g}, {cy:g}) lies outside the picture.")
    if not 0.0 < part.near_mm < part.far_mm <= 20_000.0:
        raise InputError(
            f"'{file}': near_mm must be positive and below far_mm (at most 20 m), not {part.near_mm:g} to"
            f" {part.far_mm:g}."
        )
    optimum = part.optimum_mm or 0.5 * (part.near_mm + part.far_mm)
    if not part.near_mm <= optimum <= part.far_mm:
        raise InputError(f"'{file}': optimum_mm must lie in the range from near_mm to far_mm, and it is {optimum:g}.")
    n, d = part.noise, part.distortion
    try:
        noise = DepthNoise(
            sigma_m=n.sigma_mm / 1e3,
            reference_m=optimum / 1e3,
            growth=n.growth,
            incidence=n.incidence,
            correlation_px=n.correlation_px,
            edge_step_m=n.edge_step_mm / 1e3,
            flying=n.flying,
            edge_dropout=n.edge_dropout,
            grazing_rad=math.radians(n.grazing_deg),
            dropout=n.dropout,
            dark_dropout=n.dark_dropout,
            dark_gain=n.dark_gain,
            quantum_m=n.quantum_mm / 1e3,
            warp_m=d.warp_mm / 1e3,
            scale_error=d.scale_error,
            gradient_per_m=d.gradient_error_per_m,
        )
    except InputError as error:
        raise InputError(f"'{file}': {error}") from error
    near, far = part.near_mm / 1e3, part.far_mm / 1e3
    return ScannerPreset(
        name=part.name or path.stem,
        width=part.width,
        height=part.height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        near_m=near,
        far_m=far,
        optimum_m=optimum / 1e3,
        noise=noise,
    )


def drake_intrinsics(preset: ScannerPreset) -> tuple[int, int, float, float, float, float]:
    """Return the arguments of Drake's CameraInfo: its RgbdSensor samples pixel (u, v) at (u + 0.5, v + 0.5)."""
    return preset.width, preset.height, preset.fx, preset.fy, preset.cx + 0.5, preset.cy + 0.5


def _by_area(
    name: str, width: int, height: int, near: float, optimum: float, far: float, scan_width: float, noise: DepthNoise
) -> ScannerPreset:
    """A scanner with square pixels and a centred axis; its image spans `scan_width` metres at the optimum distance."""
    f = width * optimum / scan_width
    return ScannerPreset(
        name=name,
        width=width,
        height=height,
        fx=f,
        fy=f,
        cx=0.5 * (width - 1),
        cy=0.5 * (height - 1),
        near_m=near,
        far_m=far,
        optimum_m=optimum,
        noise=noise,
    )


def _structured_light(sigma_m: float, optimum_m: float, correlation_px: float, flying: float) -> DepthNoise:
    """Photoneo's structured light: few flying pixels, gaps at edges, nothing on grazing surfaces."""
    return DepthNoise(
        sigma_m=sigma_m,
        reference_m=optimum_m,
        correlation_px=correlation_px,
        edge_step_m=0.004,
        flying=flying,
        edge_dropout=0.3,
        grazing_rad=math.radians(78.0),
        dropout=0.0005,
        dark_dropout=0.9,
        dark_gain=3.0,
    )


_STREAMED = _structured_light(5.0e-4, 0.650, 1.2, 0.15)

SCANNERS: dict[str, ScannerPreset] = {
    preset.name: preset
    for preset in (
        _by_area("phoxi_s", 2064, 1544, 0.384, 0.442, 0.520, 0.360, _structured_light(5.0e-5, 0.442, 0.8, 0.05)),
        _by_area("phoxi_m", 2064, 1544, 0.458, 0.650, 1.118, 0.590, _structured_light(1.0e-4, 0.650, 0.8, 0.05)),
        _by_area(
            "motioncam_3d_static", 1680, 1200, 0.497, 0.650, 0.939, 0.590, _structured_light(1.0e-4, 0.650, 0.8, 0.08)
        ),
        _by_area(
            "motioncam_3d_motion", 1120, 800, 0.497, 0.650, 0.939, 0.590, _structured_light(2.5e-4, 0.650, 1.2, 0.15)
        ),
        # streaming: the largest image of the second paper (section 2.3), and the same view with half a million pixels;
        # 0.5 mm
        _by_area("motioncam_3d_stream", 1068, 800, 0.497, 0.650, 0.939, 0.590, _STREAMED),
        _by_area("motioncam_3d_stream_half", 816, 612, 0.497, 0.650, 0.939, 0.590, _STREAMED),
        ScannerPreset(
            name="azure_kinect",
            width=640,
            height=576,
            fx=504.0,
            fy=504.0,
            cx=319.5,
            cy=287.5,
            near_m=0.5,
            far_m=3.86,
            optimum_m=1.0,
            noise=DepthNoise(
                sigma_m=1.0e-3,
                reference_m=1.0,
                edge_step_m=0.02,
                flying=0.7,
                edge_dropout=0.1,
                grazing_rad=math.radians(80.0),
                dark_dropout=0.8,
                dark_gain=3.0,
                quantum_m=1.0e-3,
            ),
        ),
        _by_area("ideal", 2064, 1544, 0.1, 0.650, 5.0, 0.590, DepthNoise()),
    )
}
"""Every scanner known by name, in its full resolution."""


def is_scanner_file(name: str) -> bool:
    """Return whether a preset's name is that of a file."""
    return name.lower().endswith((".yaml", ".yml"))


def get_scanner(
    name: str, width: int | None = None, height: int | None = None, field_of_view_deg: float | None = None
) -> ScannerPreset:
    """Return the named scanner, or that of a file (.yaml), resized when a width (and height) is given.

    A horizontal field of view keeps the pixels' aspect ratio.

    Raises InputError that names the known scanners, or what is wrong in the file.
    """
    if is_scanner_file(name):
        preset: ScannerPreset | None = read_scanner_file(Path(name))
    else:
        preset = SCANNERS.get(name.strip().lower().replace("-", "_"))
    if preset is None:
        listed = f"use one of {', '.join(SCANNERS)}, or a scanner file (.yaml)."
        raise InputError(f"Scanner '{name}' is not known: {did_you_mean(name, SCANNERS, listed)}")
    if width is None:
        if height is not None:
            raise InputError("A scanner is resized by its width: give the width too, or omit the height.")
    else:
        preset = preset.resized(width, height)
    if field_of_view_deg is None:
        return preset
    fx = 0.5 * preset.width / np.tan(np.deg2rad(0.5 * field_of_view_deg))
    return replace(preset, fx=float(fx), fy=float(fx * preset.fy / preset.fx))


def apply_noise(
    depth: Depth, preset: ScannerPreset, rng: np.random.Generator, dark: npt.NDArray[np.floating] | None = None
) -> Depth:
    """What the scanner returns for a perfect depth map (H,W) in metres: float32, 0 where it measured nothing.

    `dark` (H,W) from 0 to 1 says how dark the surface is. Depths outside the working range, before or after the noise,
    are not measured. Raises InputError when the map or `dark` has not the preset's size.
    """
    expected = (preset.height, preset.width)
    if depth.shape != expected or (dark is not None and dark.shape != expected):
        raise InputError(
            f"Scanner '{preset.name}' has images of {expected}: give a depth map (and dark) of that shape."
        )
    p = preset
    out = noisy_depth(np.asarray(depth, dtype=np.float32), p.noise, p.fx, p.fy, p.cx, p.cy, rng, dark)
    out[~((depth >= p.near_m) & (depth <= p.far_m) & (out >= p.near_m) & (out <= p.far_m))] = 0.0
    return out


def depth_to_points(depth: npt.NDArray[np.floating], fx: float, fy: float, cx: float, cy: float) -> Floats:
    """Organised cloud (H,W,3) in the optical frame C, metres, NaN where the depth is 0, infinite or NaN.

    Pixel (u, v) lies on the ray ((u - cx)/fx, (v - cy)/fy, 1): the OpenCV convention.
    """
    height, width = depth.shape
    with np.errstate(invalid="ignore"):
        z = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan).astype(np.float64)
    points = np.empty((height, width, 3))
    points[..., 0] = z * ((np.arange(width) - cx) / fx)[None, :]
    points[..., 1] = z * ((np.arange(height) - cy) / fy)[:, None]
    points[..., 2] = z
    return points


def cast(meshes: Sequence[TriMesh], X_BC: RigidTransform, scanner: ScannerPreset, seed: int) -> Floats:
    """What the scanner at X_BC sees of meshes given in base, its noise included: (H,W,3) m in base."""
    from weldcal.models.mesh import merge

    flat = np.ones((scanner.height, scanner.width), dtype=np.float32)
    rays_C = depth_to_points(flat, scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    R, eye = X_BC.rotation().matrix(), X_BC.translation()
    rays = np.concatenate([np.broadcast_to(eye, rays_C.shape), rays_C @ R.T], axis=2).astype(np.float32)
    # The rays have unit depth, so what the caster calls distance is depth.
    depth = merge(*meshes).scene.cast_rays(rays)["t_hit"].numpy()
    depth[~np.isfinite(depth)] = 0.0
    measured = apply_noise(depth, scanner, np.random.default_rng(seed))
    points_C = depth_to_points(measured, scanner.fx, scanner.fy, scanner.cx, scanner.cy)
    return np.asarray(points_C @ R.T + eye)
