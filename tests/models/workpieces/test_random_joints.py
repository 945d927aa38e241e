"""Joints of separate solids in random sizes and orientation: each seam with its type and its ends, and no other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.models.workpieces.random_joints import KINDS, mistakes
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.seam_input import SeamSource, seam_of
from weldcal.tools.worlds.parts.step_parts import assembly, box, write_step


@pytest.mark.parametrize("kind", KINDS)
def test_every_seam_is_listed_and_nothing_else(kind: str) -> None:
    for seed in range(3):
        assert mistakes(kind, seed) == []


@pytest.mark.parametrize(("plate", "web"), [((300, 200, 12), 10), ((250, 100, 12), 4), ((500, 150, 12), 7)])
def test_both_sides_of_a_centred_web_are_listed(plate: tuple[int, int, int], web: int, tmp_path: Path) -> None:
    length, width, _ = plate
    solids = box((0, 0, 0), plate), box((0, (width - web) / 2, 12), (length, web, 100))
    write_step(assembly(*solids), tmp_path / "t.step")
    shape = read_shape(tmp_path / "t.step")
    assert [joint.type for joint in shape.joints] == ["T", "T"]
    assert {joint.side for joint in shape.joints} == {"left", "right"}
    assert sum(edge.kind == "concave" for edge in shape.edges) == 2


@pytest.mark.parametrize("gap", [2.5, -2.0])
def test_a_web_with_a_gap_or_drawn_into_its_plate_is_a_seam(gap: float, tmp_path: Path) -> None:
    write_step(assembly(box((0, 0, -10), (200, 100, 10)), box((20, 46, gap), (160, 8, 60))), tmp_path / "t.step")
    shape = read_shape(tmp_path / "t.step")
    (joint,) = shape.joints
    assert joint.closed
    assert len(joint.edges) == 4
    assert joint.length_m == pytest.approx(0.336, abs=1e-6)
    assert joint.gap_m == pytest.approx(1e-3 * max(gap, 0.0), abs=1e-6)
    for id in joint.edges:
        seam = seam_of(shape, SeamSource(edges=(id,)), "fillet")
        assert np.abs(seam.points_P[:, 2]).max() < 1e-5


def test_either_side_of_an_open_corner_is_its_own_edge(tmp_path: Path) -> None:
    write_step(assembly(box((0, -80, -8), (200, 80, 8)), box((0, 0, 0), (200, 8, 80))), tmp_path / "c.step")
    shape = read_shape(tmp_path / "c.step")
    assert {joint.side for joint in shape.joints} == {"inside", "outside"}
    for joint in shape.joints:
        seam = seam_of(shape, SeamSource(edges=joint.edges), "fillet")
        assert seam.up_P[5] == pytest.approx(joint.up_P, abs=1e-6)
