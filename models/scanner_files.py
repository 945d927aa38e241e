"""A scanner as its user describes it: the keys of a scanner file, and its reader."""

import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from weldcal.models.depth_noise import DepthNoise
from weldcal.models.documents import read_document
from weldcal.models.errors import InputError
from weldcal.models.keys import read_part

LARGEST_PX = 8192


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
    """A scanner file. Pixels as in OpenCV: the centre of the first pixel is (0, 0). fx, fy, cx, cy, or field_of_view_deg."""

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
class ReadScanner:
    """A scanner file in pixels and metres."""

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


def read_scanner_file(path: Path) -> ReadScanner:
    """The scanner of a file.

    Raises:
        InputError: the file cannot be read, has an unknown key, or describes a scanner that cannot be.
    """
    if not path.is_file():
        raise InputError(f"There is no scanner file '{path}'.")
    return _read(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _read(path: Path, changed: int) -> ReadScanner:
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
            f"'{file}': near_mm must be positive and below far_mm (at most 20 m), not {part.near_mm:g} to {part.far_mm:g}."
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
    return ReadScanner(
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
