"""A coarse line becomes a groove's: slices across it are fitted, and it is moved to their centres until it stays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from weldcal.welding.locate.groove_corner import Corner
from weldcal.welding.locate.groove_line import Line, smoothing_weights
from weldcal.welding.locate.groove_seam import GrooveConfig, GrooveNotFound, GrooveTooNarrow
from weldcal.welding.locate.groove_search import CoarseGroove
from weldcal.welding.locate.groove_section import BAND_M, Profile, Section, fit_section
from weldcal.welding.locate.planes import Floats

STATION_M = 0.001
FOLLOW = 3.0  # times wider than the last smoothing: a line moved again and again keeps ever more of the noise
SLOPE_SIGMA = 0.06  # relative, of a slice about the common profile: 2 deg between the walls of a 45 deg groove
DEPTH_SIGMA = 0.10


@dataclass(frozen=True, eq=False)
class Slices:
    """Fitted sections along a line: where, and their sigma sideways and in height (not yet scaled)."""

    s: Floats
    sections: list[Section]
    half_slice: float

    def column(self, name: str) -> Floats:
        return np.array([getattr(section, name) for section in self.sections], dtype=np.float64)

    @property
    def sigma(self) -> Floats:
        return np.sqrt([section.covariance[0, 0] for section in self.sections])

    @property
    def sigma_height(self) -> Floats:
        return np.sqrt([section.covariance[1, 1] for section in self.sections])


def measured_profile(f: Floats, line: Line, groove: CoarseGroove, config: GrooveConfig) -> Profile:
    """The groove's cross-section over its whole length, from the coarse line."""
    _, n, beside = line.coordinates(f[:, :2])
    beside &= np.abs(n) < 0.5 * groove.width_m + BAND_M + 0.003
    n, z = n[beside], f[beside, 2]
    if groove.width_m < config.least_pitches * groove.pitch_m * 0.7:
        raise _too_narrow(groove.width_m, groove.pitch_m, config)
    inner = np.abs(n) < 0.3 * groove.width_m
    if np.count_nonzero(inner) < 20:
        raise GrooveNotFound(
            f"An opening {1e3 * groove.width_m:.1f} mm wide was seen, but nothing in it: look from above."
        )
    depth = -float(np.percentile(z[inner], 10.0))
    slope = depth / (0.5 * groove.width_m)
    guess = Profile((slope, slope), depth, slope_sigma=1.0, depth_sigma=1.0)
    # The coarse line wanders by a fraction of a millimetre, which on the walls looks like noise.
    best = fit_section(n, z, (0.0, guess), max(groove.sigma_m, 2e-4), groove.pitch_m, faces_known=False)
    if (
        best is None
        or best.agreeing < 0.2
        or best.depth < 5.0 * groove.sigma_m
        or max(best.slopes) > math.tan(config.steepest_wall_rad)
    ):
        raise GrooveNotFound(
            f"An opening {1e3 * groove.width_m:.1f} mm wide and {1e3 * depth:.1f} mm deep was seen, but it has no two "
            "sloping walls: it is a gap or a step, not a V-groove."
        )
    if best.width < config.least_pitches * groove.pitch_m:
        raise _too_narrow(best.width, groove.pitch_m, config)
    # About a wandering line one wall looks steeper than the other; what they have in common is nearer to the truth.
    slope = float(np.mean(best.slopes))
    return Profile((slope, slope), best.depth)


def common_profile(f: Floats, line: Line, slices: Slices, profile: Profile, sigma: float, pitch: float) -> Profile:
    """The profile of all points about the slices' centres: known so much better that the next slices may differ less."""
    if len(slices.s) < 5:
        return profile
    s, n, beside = line.coordinates(f[:, :2])
    half_width = profile.depth / min(profile.slopes)
    beside &= (s > slices.s[0]) & (s < slices.s[-1]) & (np.abs(n) < half_width + BAND_M)
    beside &= f[:, 2] > -1.3 * profile.depth - 4.0 * sigma
    n = n - np.interp(s, slices.s, slices.column("centre"))
    # Slices that were steadied by the last profile would only repeat it: these points are asked anew.
    slope = float(np.mean(profile.slopes))
    loose = Profile((slope, slope), profile.depth, slope_sigma=0.5, depth_sigma=0.5)
    whole = fit_section(n[beside], f[beside, 2], (0.0, loose), sigma, pitch)
    return profile if whole is None else Profile(whole.slopes, whole.depth, SLOPE_SIGMA, DEPTH_SIGMA)


def _too_narrow(width: float, pitch: float, config: GrooveConfig) -> GrooveTooNarrow:
    return GrooveTooNarrow(
        f"The groove is {1e3 * width:.1f} mm wide and the scan's points are {1e3 * pitch:.1f} mm apart: "
        f"{width / pitch:.1f} of the {config.least_pitches:.0f} point distances it takes; move the scanner nearer or use "
        "a finer one."
    )


def cut_slices(
    f: Floats, line: Line, profile: Profile, sigma: float, pitch: float, half_slice: float, corners: list[Corner]
) -> Slices:
    """Sections one beside the other along a line, each from points of its own; none within reach of a sharp corner."""
    half_width = profile.depth / min(profile.slopes)
    s, n, beside = line.coordinates(f[:, :2])
    # What lies deeper than the root is the table beyond the plate's edge.
    beside &= (np.abs(n) < half_width + BAND_M + 0.002) & (f[:, 2] > -1.3 * profile.depth - 4.0 * sigma)
    order = np.argsort(s[beside])
    s, n, z = (v[beside][order] for v in (s, n, f[:, 2]))
    centers = np.arange(half_slice, line.length, 2.0 * half_slice)
    bounds = np.searchsorted(s, np.append(centers - half_slice, centers[-1] + half_slice))
    keep, sections = [], []
    for k, center in enumerate(centers):
        if any(abs(center - c.s) < c.blind for c in corners):
            continue
        part = slice(bounds[k], bounds[k + 1])
        section = fit_section(n[part], z[part], (0.0, profile), sigma, pitch)
        if section is None or section.agreeing < 0.4 or not 0.5 < section.depth / profile.depth < 1.6:
            continue
        if abs(section.centre) < half_width and math.sqrt(section.covariance[0, 0]) < 0.4 * half_width:
            keep.append(center)
            sections.append(section)
    return Slices(np.array(keep), sections, half_slice)


def agreed(slices: Slices) -> Slices:
    """Without the sections that have few points, or that their neighbours deny."""
    if len(slices.s) < 5:
        return slices
    points = np.array([sum(x.on_walls) for x in slices.sections])
    good = points >= max(5.0, 0.35 * float(np.median(points)))
    for name, least in (("centre", 3e-4), ("root", 6e-4)):
        value = slices.column(name)
        # Against a smooth curve through the others near it: a bend is not an outlier.
        W = smoothing_weights(slices.s, slices.s, np.ones(len(value)), 3.0 * slices.half_slice)
        own = np.diag(W)
        off = np.abs(value - W @ value) / np.maximum(1.0 - own, 0.2)
        good &= off < max(least, 6.0 * float(np.median(off)))
    return Slices(slices.s[good], [x for x, keep in zip(slices.sections, good, strict=True) if keep], slices.half_slice)


def followed(
    f: Floats,
    line: Line,
    profile: Profile,
    sigma: float,
    pitch: float,
    half_slice: float,
    config: GrooveConfig,
    settled: bool,
) -> Line:
    """The line moved to where its sections have their centres, smoothly."""
    slices = cut_slices(f, line, profile, sigma, pitch, half_slice, [])
    slices = agreed(slices) if settled else slices
    if len(slices.s) < 5:
        raise GrooveNotFound("An opening was seen whose cross-sections show no V: it is not a groove to weld.")
    r, weight = slices.column("centre"), slices.sigma
    at = np.arange(0.0, line.length + STATION_M, STATION_M)
    # Wider than the last smoothing: moving a line again and again keeps ever more of the noise.
    width = FOLLOW * max(config.smoothing_m, 2.0 * half_slice)
    for _ in range(2):
        smooth = smoothing_weights(slices.s, slices.s, weight, width) @ r
        off = np.abs(r - smooth)
        # A section that its neighbours deny counts for little.
        weight = np.where(off > 4.0 * np.median(off) + 5e-5, 10.0, 1.0) * slices.sigma
    W = smoothing_weights(np.clip(at, slices.s[0], slices.s[-1]), slices.s, weight, width)
    moved = line.moved(at, W @ r)
    # Where nothing was seen the coarse line is not to be believed: the sides that were seen say how it goes on.
    stretch = moved.length / line.length
    for k in np.flatnonzero(np.diff(slices.s) > 0.010)[::-1]:
        a, b = stretch * float(slices.s[k]), stretch * float(slices.s[k + 1])
        if a > 0.005 and b < moved.length - 0.005:
            moved = moved.bridged(a, b)
    return moved
