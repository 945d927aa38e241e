"""Profiles of an adhesive bead on a slightly bent plate: lopsided, with smooth toes, noise, drop-outs and spatter.

The cross-section is two halves of superellipses, smeared by a Gaussian. Width, height and area follow from the fine
curve over the plate that it was laid on, before a point of it was sampled.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from weldcal.calibration.profiler.motion import Floats

STEP_M = 2e-6  # of the fine curve
PITCH_M = 0.1e-3
STANDOFF_M = 0.2
TOE_M = 0.2e-3
CLEAR_M, FLANK_M = 0.8e-3, 2e-3  # outside and inside a toe, where no ball lies unless it may be anywhere


@dataclass(frozen=True, kw_only=True)
class Section:
    """One cross-section: half widths left and right, height, exponent, smear of the toes, m."""

    halves_m: tuple[float, float] = (5.6e-3, 6.4e-3)
    height_m: float = 3.5e-3
    exponent: float = 2.2
    smear_m: float = 0.25e-3

    def curve(self, half_view_m: float) -> tuple[Floats, Floats]:
        """Places and heights (n,) m of the fine curve over a flat plate."""
        u = np.arange(-half_view_m, half_view_m, STEP_M)
        r = np.abs(u) / np.where(u < 0.0, *self.halves_m)
        w = self.height_m * np.clip(1.0 - r**self.exponent, 0.0, None) ** (1.0 / self.exponent)
        return u, np.asarray(gaussian_filter1d(w, self.smear_m / STEP_M))

    def true(self, toe_m: float = TOE_M, corner: float = 0.0) -> Floats:
        """Width and height (m) and area (m2) between the places where the height falls below ``toe_m``."""
        u, w = self.curve(15e-3)
        w = w - max(corner, 0.0) * np.abs(u)
        inside = w >= toe_m
        return np.array([inside.sum() * STEP_M, w.max(), w[inside].sum() * STEP_M])


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """What the profiler adds: sigma (m) of a sample, `smooth` neighbours share it; step, and shares of samples."""

    noise_m: float = 0.05e-3
    smooth: int = 1
    step_m: float = 0.01e-3
    dropped: float = 0.03
    spikes: float = 0.01
    balls: float = 1.0
    anywhere: bool = False
    half_view_m: float = 20e-3


def profile(
    section: Section,
    rng: np.random.Generator,
    sensor: Sensor | None = None,
    *,
    bend_m: float = 2.0,
    corner: float = 0.0,
    jitter: bool = True,
) -> Floats:
    """Return a profile (n, 2) [x, z] m, z away from the sensor, NaN where nothing returned.

    Args:
        bend_m: radius of the plate. corner: slope of two plates that meet under the bead, up to both sides or (negative) down.
        jitter: place and tilt of the bead in the profile are random.
    """
    sensor = sensor or Sensor()
    u, w = section.curve(sensor.half_view_m + 4e-3)
    plate = u**2 / (2.0 * bend_m) + corner * np.abs(u)
    v = np.maximum(plate, w) if corner > 0.0 else plate + w
    over = v - plate
    tilt = np.radians(rng.uniform(-6.0, 6.0)) * (jitter and corner == 0.0)
    shift = rng.uniform(-2e-3, 2e-3) * jitter
    x = np.arange(-sensor.half_view_m, sensor.half_view_m, PITCH_M)
    up = np.interp(x, np.cos(tilt) * u - np.sin(tilt) * v + shift, np.sin(tilt) * u + np.cos(tilt) * v)
    foot = u[over > TOE_M] if over.max() > TOE_M else u[:1]
    ends = np.cos(tilt) * foot[[0, -1]] + shift
    laid = [np.inf]
    for _ in range(rng.poisson(sensor.balls)):
        radius = rng.uniform(0.15e-3, 0.5e-3)
        while True:
            centre = rng.uniform(x[0], x[-1])
            outside = np.array([ends[0] - centre, centre - ends[1]])
            away = (outside > radius + CLEAR_M).any() or (outside < -radius - FLANK_M).all()
            if (sensor.anywhere or away) and np.abs(centre - np.array(laid)).min() > 2.0 * radius + CLEAR_M:
                break
        laid.append(centre)
        near = np.abs(x - centre) < radius
        up[near] = up[near] + radius + np.sqrt(radius**2 - (x[near] - centre) ** 2)
    noise = rng.standard_normal(len(x) + sensor.smooth - 1)
    up += sensor.noise_m * np.convolve(noise, np.ones(sensor.smooth), "valid") / np.sqrt(sensor.smooth)
    for k in np.flatnonzero(rng.random(len(x)) < sensor.spikes):
        up[k : k + rng.integers(1, 4)] += rng.uniform(-15e-3, 15e-3)
    z = sensor.step_m * np.round((STANDOFF_M - up) / sensor.step_m)
    z[rng.random(len(x)) < sensor.dropped] = np.nan
    return np.column_stack([x, z])


def sections(count: int, rng: np.random.Generator) -> Iterator[Section]:
    """Beads about 12 mm wide and 3 to 4 mm high, each of another shape."""
    for _ in range(count):
        left, right = rng.uniform(5.0e-3, 7.0e-3, 2)
        yield Section(
            halves_m=(left, right),
            height_m=rng.uniform(3e-3, 4e-3),
            exponent=rng.uniform(1.8, 2.6),
            smear_m=rng.uniform(0.2e-3, 0.5e-3),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Seam:
    """A bead along x of the base, scanned obliquely: profiles, poses of the scan plane (n, 4, 4), truth across it."""

    profiles: list[Floats]
    X_BS: Floats
    station_m: Floats
    true: Floats


def seam(
    count: int, rng: np.random.Generator, changed: dict[int, float] | None = None, sensor: Sensor | None = None
) -> Seam:
    """A bead whose height swells slowly; ``changed``: factors on the height of single profiles."""
    station = 2e-3 * np.arange(count) + rng.uniform(-0.3e-3, 0.3e-3, count)
    profiles, poses, true = [], [], []
    for k, s in enumerate(station):
        height = (3.5e-3 + 0.2e-3 * np.sin(s / 20e-3)) * (changed or {}).get(k, 1.0)
        section = Section(height_m=height)
        true.append(section.true())
        yaw = np.radians(rng.uniform(5.0, 25.0))
        wide = 1.0 / np.cos(yaw)
        left, right = section.halves_m
        cut = Section(halves_m=(left * wide, right * wide), height_m=height, smear_m=section.smear_m * wide)
        profiles.append(profile(cut, rng, sensor, bend_m=1e9, jitter=False))
        X = np.eye(4)
        X[:3, :3] = np.array([[np.sin(yaw), np.cos(yaw), 0.0], [np.cos(yaw), -np.sin(yaw), 0.0], [0.0, 0.0, -1.0]]).T
        X[:3, 3] = [s, 0.1, STANDOFF_M + 0.3]
        poses.append(X)
    return Seam(profiles=profiles, X_BS=np.array(poses), station_m=station, true=np.array(true))
