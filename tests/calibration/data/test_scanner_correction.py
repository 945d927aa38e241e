"""A scanner correction: one factor for every point, its derivative, and what it does to a face."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RigidTransform

from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.eye_on_base.estimate import corrected_observation
from weldcal.calibration.flange.observation import Observation
from weldcal.models.errors import InputError

CORRECTION = ScannerCorrection(1.002, (0.015, -0.02))
FIELD = (-0.15, 0.15, -0.25, 0.15)
BENT = ScannerCorrection(1.002, (0.015, -0.02), (0.1, -0.2, 0.3, 1.0, 2.0, -3.0, 4.0), FIELD)


def test_a_point_is_scaled_by_the_factor_of_its_place_in_the_image() -> None:
    p = np.array([[0.1, -0.2, 0.5], [0.0, 0.0, 0.4]])
    factor = np.array([1.002 + 0.015 * 0.1 + 0.02 * 0.2, 1.002])
    assert np.allclose(CORRECTION.points(p), p * factor[:, None], atol=1e-15)
    assert np.isnan(CORRECTION.points(np.full(3, np.nan))).all()


@pytest.mark.parametrize("place", [(0.1, -0.2, 0.5), (0.3, -0.2, 0.5)], ids=["in the field", "beyond it"])
@pytest.mark.parametrize("correction", [CORRECTION, BENT], ids=["scale", "bends"])
def test_the_jacobian_is_the_slope_of_the_correction(
    correction: ScannerCorrection, place: tuple[float, float, float]
) -> None:
    p, h = np.array(place), 1e-6
    slope = [(correction.points(p + d) - correction.points(p - d)) / (2 * h) for d in h * np.eye(3)]
    # central differences are exact but for h^2 times a fourth derivative below 10, and rounding, 1e-16 / 1e-6
    assert np.allclose(correction.jacobian(p), np.transpose(slope), atol=1e-9)


def test_a_bend_is_the_sum_of_its_powers_and_stays_as_at_the_edge_beyond_its_field() -> None:
    bend = ScannerCorrection(1.0, (0.0, 0.0), (0.1, -0.2, 0.3, 1.0, 2.0, -3.0, 4.0), FIELD)
    x, y = 0.1, -0.2
    factor = 1.0 + 0.1 * x**2 - 0.2 * x * y + 0.3 * y**2 + x**3 + 2 * x**2 * y - 3 * x * y**2 + 4 * y**3
    assert np.allclose(bend.points(np.array([x, y, 0.5])), factor * np.array([x, y, 0.5]), atol=1e-15)
    edge, far = (float(bend.factor(np.array([x, 0.0, 0.5]))) for x in (0.15, 0.4))
    assert far == edge
    assert edge != 1.0


def test_the_normal_stays_upright_on_the_corrected_face() -> None:
    p, n = np.array([0.1, -0.1, 0.45]), np.array([0.2, -0.1, -0.97])
    n = n / np.linalg.norm(n)
    across = np.linalg.svd(n[None])[2][1:]
    h = 1e-4
    corrected = CORRECTION.points(np.array([p, *(p + h * across), *(p - h * across)]))
    seen = np.cross(corrected[1] - corrected[3], corrected[2] - corrected[4])
    seen = seen / np.linalg.norm(seen) * np.sign(seen @ n)
    assert np.allclose(CORRECTION.normals(p, n), seen, atol=1e-9)
    assert np.degrees(np.arccos(min(1.0, float(seen @ n)))) > 0.1  # it does turn


def test_an_observation_is_corrected_whole() -> None:
    o = Observation("a", RigidTransform(), np.array([0.1, 0.0, 0.5]), np.array([0.0, 0.0, -1.0]))
    c = corrected_observation(CORRECTION, o)
    assert np.allclose(c.p_CR, CORRECTION.points(o.p_CR))
    assert c.n_C is not None
    assert np.allclose(c.n_C, CORRECTION.normals(o.p_CR, np.array([0.0, 0.0, -1.0])))
    assert corrected_observation(CORRECTION, Observation("b", RigidTransform(), o.p_CR)).n_C is None


def test_it_is_written_and_read_back() -> None:
    assert correction_from_document(CORRECTION.document()) == CORRECTION
    assert "bend_per_m2" not in CORRECTION.document()
    assert correction_from_document(BENT.document()) == BENT
    assert correction_from_document(None) is None


@pytest.mark.parametrize(
    "document", [{}, {"scale": "one", "gradient_per_m": [0, 0]}, {"scale": 1.0, "gradient_per_m": [0.0]}]
)
def test_what_is_no_correction_is_refused(document: dict[str, object]) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        correction_from_document(document)


@pytest.mark.parametrize("scale", [0.9, 1.2, float("nan")])
def test_a_scale_no_scanner_has_is_refused(scale: float) -> None:
    with pytest.raises(InputError, match="within 5 % of 1"):
        ScannerCorrection(scale)
