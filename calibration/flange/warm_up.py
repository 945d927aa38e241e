"""Compiles the flange fit's loops by fitting a synthetic flange once."""

from functools import cache

import numpy as np

from weldcal.calibration.flange.fit import fit_flange
from weldcal.models.flanges import get_flange

_FLANGE = "iso9409-1-50-4-m6"
_WIDTH, _DISTANCE_M = 220, 0.6
_NOISE_M = 3e-5  # a choice: any noise of a good scanner takes the paths of the fit that are to be compiled


@cache
def warm_up() -> None:
    """Run every path of the flange fit once per process.

    0.05 s, or some seconds where the loops are not compiled yet.
    """
    standard = get_flange(_FLANGE)
    pitch = 2.6 * standard.face_outer_radius_m / _WIDTH
    v, u = np.mgrid[:_WIDTH, :_WIDTH] - 0.5 * (_WIDTH - 1)
    rho = pitch * np.hypot(u, v)
    face = (rho < standard.face_outer_radius_m) & (rho > standard.face_inner_radius_m)
    noise = _NOISE_M * np.random.default_rng(0).standard_normal(face.shape)
    z = np.where(face, _DISTANCE_M + noise, np.nan)
    points = np.stack([z * u * pitch / _DISTANCE_M, z * v * pitch / _DISTANCE_M, z], axis=-1)
    found = fit_flange(points, standard)
    fit_flange(points, standard, guess=found)
    fit_flange(points[face], standard)
