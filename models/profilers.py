"""Simulates a laser profiler: rays of one plane cast onto meshes, with noise, rounding, spikes and missing returns.

Frame S: x along the laser line, z away from the sensor, y across the plane of light; a profile point [x, z] is (x, 0,
z).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weldcal.models.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ProfilerPreset:
    """What a profiler sees: samples over a width, between two distances, with its errors (all m; shares of samples).

    Attributes:
        quantum_m: rounds z; share_missing and share_spikes of the samples are lost, or off by up to spike_m.
    """

    samples: int = 300
    width_m: float = 0.048
    near_m: float = 0.055
    far_m: float = 0.100
    sigma_x_m: float = 0.0
    sigma_z_m: float = 0.05e-3
    quantum_m: float = 0.1e-3
    share_missing: float = 0.01
    share_spikes: float = 0.005
    spike_m: float = 8e-3

    def __post_init__(self) -> None:
        if self.samples < 2 or not self.width_m > 0.0 or not 0.0 <= self.near_m < self.far_m:
            raise InputError("A profiler needs two samples or more, a width, and a far limit beyond its near one.")

    @property
    def x_m(self) -> Floats:
        """Where the samples lie along the line (samples,)."""
        return np.linspace(-0.5 * self.width_m, 0.5 * self.width_m, self.samples)


def with_noise(profiles: Floats, preset: ProfilerPreset, rng: np.random.Generator) -> Floats:
    """Return the same profiles (..., 2) as a real sensor returns them."""
    p = np.array(profiles, float)
    shape = p.shape[:-1]
    p[..., 0] += preset.sigma_x_m * rng.standard_normal(shape)
    p[..., 1] += preset.sigma_z_m * rng.standard_normal(shape)
    if preset.quantum_m > 0.0:
        p[..., 1] = np.round(p[..., 1] / preset.quantum_m) * preset.quantum_m
    spikes = rng.random(shape) < preset.share_spikes
    p[spikes, 1] += rng.uniform(-preset.spike_m, preset.spike_m, int(spikes.sum()))
    p[rng.random(shape) < preset.share_missing] = np.nan
    return p
