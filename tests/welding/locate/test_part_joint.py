"""The joint measured along the drawn seam: where the part is made differently the root follows the walls."""

from __future__ import annotations

import numpy as np
import pytest

from tests.worlds.parts.scans import subject
from weldcal.welding.locate.part.joint import measure_joint
from weldcal.welding.locate.part.model import PartModel

pytest.importorskip("OCP")
PITCH_M = 0.001


def scanned(name: str, shift: np.ndarray, upper: float, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Points with normals on the part about its seam, as it would be made `shift` off, where z is above `upper`."""
    part, rng = subject(name), np.random.default_rng(seed)
    points, normals = part.mesh.sample(400_000, rng)
    low, high = part.seam.points_P.min(axis=0) - 0.02, part.seam.points_P.max(axis=0) + 0.02
    keep = ((points > low) & (points < high)).all(axis=1) & (normals[:, 2] > 0.1) & (points[:, 2] > upper)
    points, normals = points[keep], normals[keep]
    some = rng.choice(len(points), min(len(points), 6000), replace=False)
    return points[some] + shift + rng.normal(0.0, 5e-5, (len(some), 3)), normals[some]


def test_a_groove_made_beside_its_place_is_found_there() -> None:
    part, shift = subject("bevelled_plates"), np.array([0.0, 0.0006, -0.0004])
    points, normals = scanned("bevelled_plates", shift, -1.0)
    found = measure_joint(points, normals, PITCH_M, PartModel(part.mesh), part.seam)
    moved = found.seam.points_P - part.seam.points_P
    middle = moved[len(moved) // 10 : -len(moved) // 10]
    assert found.share > 0.9
    assert middle[:, 1] == pytest.approx(shift[1], abs=1.5e-4)
    assert middle[:, 2] == pytest.approx(shift[2], abs=1.5e-4)
    assert found.sigma_m < 2e-4


def test_what_the_scan_does_not_show_is_as_drawn() -> None:
    part = subject("bevelled_plates")
    points, normals = scanned("bevelled_plates", np.zeros(3), -0.0005)  # the faces beside the groove only
    found = measure_joint(points, normals, PITCH_M, PartModel(part.mesh), part.seam)
    assert found.share == 0.0
    assert np.linalg.norm(found.seam.points_P - part.seam.points_P, axis=1).max() < 1e-4
