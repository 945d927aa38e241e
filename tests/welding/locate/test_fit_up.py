"""The fit-up along a seam: two solids displaced by a known gap, offset and angle, scanned by a ray caster of its
own."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

import weldcal.models.scenarios
from tests.welding.locate.lying import FLOOR, TABLE, Solid, box, looking, pose, put, scan, triangles
from weldcal.models.errors import InputError
from weldcal.models.mesh import TriMesh
from weldcal.models.workpieces.drawing import draw_seam
from weldcal.models.workpieces.seams import DrawnSeam
from weldcal.welding.locate.part.fit_up import FIT_UP, FitUp, FitUpOutside, check_fit_up, read_limits
from weldcal.welding.locate.part.joint import _opening, measure_fit_up
from weldcal.welding.locate.part.model import PartModel
from weldcal.welding.locate.planes import into
from weldcal.welding.locate.planning import _about_seam

MM = 1e-3
SHIPPED = Path(weldcal.models.scenarios.__file__).with_name("fit_up_limits.csv")
LINES = {"butt": (0.0, 0.0, 1.0), "fillet": (0.0, 0.7, 0.7), "lap": (0.0, 0.7, 0.7)}
UNIT = {"gap": 1e-3, "misalignment": 1e-3, "angle": math.radians(1.0)}


def parts(joint: str, gap: float, aside: float, angle: float) -> list[Solid]:
    """Two solids with the seam along x at y = z = 0, the second one displaced: gap and offset m, turned by an angle rad
    about the seam."""
    first = box((-0.11, 0.11), (-0.07, 0.05 if joint != "butt" else 0.0), (-0.008, 0.0))
    turn = (angle, 0.0, 0.0)
    if joint == "butt":  # it stands to the left, and lower by `aside`, open by the angle
        second = put([box((-0.11, 0.11), (0.0, 0.06), (-0.008, 0.0))], pose((0.0, gap, -aside), turn))
    elif joint == "fillet":  # a web, leaning
        second = put([box((-0.10, 0.10), (-0.006, 0.0), (0.0, 0.06))], pose((0.0, 0.0, gap), turn))
    else:
        second = put([box((-0.10, 0.10), (-0.05, 0.0), (0.0, 0.006))], pose((0.0, 0.0, gap), turn))
    return [first, *second]


@cache
def drawn(joint: str) -> tuple[PartModel, DrawnSeam]:
    mesh = TriMesh(*triangles(parts(joint, 0.0, 0.0, 0.0)))
    line = np.array([[-0.095, 0.0, 0.0], [0.095, 0.0, 0.0]])
    return PartModel(mesh), draw_seam(mesh, line, joint, np.tile(LINES[joint], (2, 1)))


@cache
def scanned(joint: str, seed: int) -> tuple[FitUp, dict[str, float]]:
    """The fit-up that is found, and the true one."""
    rng = np.random.default_rng([seed, 43])
    gap = max(0.0, rng.uniform(-0.5, 3.0)) * 1e-3
    aside = rng.uniform(-1.5, 1.5) * 1e-3 if joint == "butt" else 0.0
    angle = math.radians(rng.uniform(-2.5, 2.5)) if joint != "lap" else 0.0
    if joint == "butt" and gap == 0.0:
        aside = 0.0  # plates that touch
    X = pose((0.6, 0.0, 0.008), (0.0, 0.0, rng.uniform(-3.0, 3.0)))
    side = rng.uniform(0.25, 0.45) if joint != "butt" else rng.uniform(-0.15, 0.15)
    eye = X[:3, :3] @ np.array([rng.uniform(-0.1, 0.1), side, 0.75]) + X[:3, 3]
    cloud = scan([*put(parts(joint, gap, aside, angle), X), TABLE, FLOOR], looking(eye, X[:3, 3]), rng)
    points = cloud.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    # a registration that follows neither of the two parts exactly
    X_BP = RigidTransform(X) @ RigidTransform(RollPitchYaw(0.3 * angle, 0.0, 0.002), [0.0, 0.3 * gap, -0.3 * aside])
    model, seam = drawn(joint)
    near, normals = _about_seam(into(X_BP, points), into(X_BP, eye[None])[0], seam)
    pitch = 0.75 / 850.0
    true = {"gap": gap, "angle": -angle if joint == "butt" else angle}
    # the fillet's web is turned about its foot, by which its left lower edge stays; the first plate is on the right
    if joint == "butt":
        true["misalignment"] = -aside
    return measure_fit_up(near, normals, pitch, model, seam), true


@cache
def judged(joint: str, name: str) -> tuple[float, float, float]:
    """Root mean square of a quantity's error in mm or deg over six scenes, largest error, and mean square in units of
    the stated sigma."""
    off, z = [], []
    for seed in range(100, 106):
        found, true = scanned(joint, seed)
        assert np.isfinite(found.values[name]).mean() > 0.7
        e = found.values[name] - true[name]
        off.append(e[np.isfinite(e)] / UNIT[name])
        z.append((e / found.sigmas[name])[np.isfinite(e)])
    error = np.concatenate(off)
    return float(np.sqrt(np.mean(error**2))), float(np.abs(error).max()), float(np.mean(np.concatenate(z) ** 2))


LARGEST = {
    ("butt", "gap"): (0.15, 0.5), ("butt", "misalignment"): (0.1, 0.25), ("butt", "angle"): (0.6, 1.5),
    ("fillet", "gap"): (0.4, 1.0), ("fillet", "angle"): (0.6, 1.5), ("lap", "gap"): (0.06, 0.15),
}  # fmt: skip
"""Root mean square and largest error, with points 0.9 mm apart and noise of 0.1 mm."""


@pytest.mark.parametrize(("joint", "name"), LARGEST)
def test_displaced_parts_are_measured_as_they_stand(joint: str, name: str) -> None:
    """From both sides: a sigma four times too wide or too narrow is out of the bounds."""
    rms, most, squares = judged(joint, name)
    assert rms < LARGEST[joint, name][0]
    assert most < LARGEST[joint, name][1]
    assert 0.1 < squares < 3.0


@pytest.mark.parametrize("turn", [0.0, 0.2])
def test_the_end_of_a_face_lies_between_two_points(turn: float) -> None:
    """Rows of points 1 mm apart, along the seam or askew, at all places; with one point that strays into the gap."""
    gap, off, z = 1.7 * MM, [], []
    x, s = (v.ravel() * MM for v in np.meshgrid(*[np.arange(-40.0, 41.0)] * 2))
    for a, b in MM * np.array([(0.05 * k, 0.2 * j) for k in range(20) for j in range(5)]):
        left, along = a + x * math.cos(turn) - s * math.sin(turn), b + x * math.sin(turn) + s * math.cos(turn)
        on = (np.abs(left) > 0.5 * gap) & (np.abs(left) < 15 * MM) & (np.abs(along) < 10 * MM)
        rows = np.column_stack([left, 0.0 * left, along])[on]
        found, sigma = _opening(np.vstack([rows, [[0.0, 0.0, 0.0]]]) if turn else rows)
        off.append(found - gap)
        z.append((found - gap) / sigma)
    assert np.mean(off) == pytest.approx(0.0, abs=0.06 * MM)
    assert 0.1 < np.mean(np.square(z)) < 3.0


def test_a_lap_has_no_misalignment_and_a_fillet_none() -> None:
    assert set(scanned("lap", 100)[0].values) == {"gap"}
    assert set(scanned("fillet", 100)[0].values) == {"gap", "angle"}


FOUND = FitUp(
    np.array([0.005, 0.015, 0.025]),
    {"gap": np.array([0.0005, 0.0021, np.nan]), "angle": np.radians([1.0, -2.0, -7.0])},
    {"gap": np.array([0.0002, 0.0002, np.nan]), "angle": np.radians([0.3, 0.3, 0.3])},
)


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        ("gap,mm,0,1.6", r"at 15 mm of the seam the gap is 2\.10 mm \(sigma 0\.20\), and its limit is 1\.6 mm"),
        (
            "gap,mm,,1.6\nangle,deg,-5,10",
            r"at 25 mm of the seam the angle is -7\.00 deg \(sigma 0\.30\), and its limit is -5 deg",
        ),
        ("misalignment,mm,-1,1", "does not show the joint's misalignment"),
    ],
)
def test_out_of_limits_names_place_value_and_limit(tmp_path: Path, limits: str, says: str) -> None:
    table = tmp_path / "limits.csv"
    table.write_text(f"quantity,unit,least,most\n{limits}  # a note\n")
    with pytest.raises(FitUpOutside, match=says):
        check_fit_up(FOUND, read_limits(table), "butt")


def test_within_limits_is_accepted_and_what_a_joint_has_not_needs_no_limit(tmp_path: Path) -> None:
    table = tmp_path / "limits.csv"
    table.write_text("gap,mm,0,2.1\n\nangle,deg,-7,\nmisalignment,mm,-1,1\n")
    check_fit_up(FOUND, read_limits(table), "fillet")


@pytest.mark.parametrize("row", ["gap,deg,0,1", "hi-lo,mm,0,1", "gap,mm,0", "gap,mm,zero,1", "gap,mm,2,1"])
def test_a_wrong_line_of_limits_is_named(tmp_path: Path, row: str) -> None:
    table = tmp_path / "limits.csv"
    table.write_text(f"quantity,unit,least,most\n{row}\n")
    with pytest.raises(InputError, match="line 2"):
        read_limits(table)


def test_the_shipped_table_is_one() -> None:
    assert set(read_limits(SHIPPED)) == set(FIT_UP)
