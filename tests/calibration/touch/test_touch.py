"""Touched points against what a calibration states, and the table that an operator writes of them."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from typer.testing import CliRunner

from tests.worlds.touch import TouchWorld, touch_world
from weldcal.calibration.data.results import save_result
from weldcal.calibration.data.scanner_correction import ScannerCorrection, correction_from_document
from weldcal.calibration.touch.judge import judge_touches
from weldcal.calibration.touch.touches import (
    CAMERA,
    DIRECTION,
    POINT,
    POSE,
    REQUIRED,
    TIP,
    Touch,
    fit_touched_plane,
    fit_touched_sphere,
    read_touches,
)
from weldcal.models.errors import InputError
from weldcal.tools.cli.app import app


@lru_cache(maxsize=8)
def world(seed: int) -> TouchWorld:
    return touch_world(seed)


def row(t: Touch) -> dict[str, str]:
    """A touch as its row of the table."""
    numbers = [*t.X_BF.translation(), *t.X_BF.rotation().ToQuaternion().wxyz(), *t.p_FT, t.radius, *t.p_C]
    cells = {"id": t.id, "feature": t.feature}
    cells |= {c: repr(float(v)) for c, v in zip((*POSE, *TIP, *CAMERA), numbers, strict=True)}
    cells |= {c: "" if t.direction_C is None else repr(float(t.direction_C[i])) for i, c in enumerate(DIRECTION)}
    return cells | {"feature_radius": repr(t.feature_radius), "cloud": "", "within": ""}


def table(path: Path, rows: list[dict[str, str]]) -> Path:
    path.write_text("\n".join([",".join(rows[0]), *(",".join(r.values()) for r in rows)]) + "\n")
    return path


def test_touches_of_many_worlds_lie_inside_as_often_as_stated_and_those_of_a_wrong_calibration_do_not() -> None:
    """Five worlds: of 30 touches 28.5 are expected with a deviation of 1.2 were they independent."""
    found = [judge_touches(each.result, each.touches) for each in map(world, range(20, 25))]
    inside = np.concatenate([f.inside for f in found])
    assert inside.sum() >= 25
    assert sum(f.outside > f.most_outside for f in found) <= 1
    wrong = world(20)
    X = wrong.result.X_BC
    moved = replace(wrong.result, X_BC=RigidTransform(X.rotation(), np.add(X.translation(), [0.0, 0.0, 3e-3])))
    judged = judge_touches(moved, wrong.touches)
    assert judged.outside > judged.most_outside


def test_from_point_to_point_a_shift_of_all_does_not_count() -> None:
    """What a weld needs that starts from a touch: the seam in the scan relative to the torch, not the base."""
    result, touches = world(20).result, tuple(replace(t, feature=POINT, radius=0.0) for t in world(20).touches)
    shifted = replace(
        result, X_BC=RigidTransform(result.X_BC.rotation(), np.add(result.X_BC.translation(), [1e-3, -2e-3, 1e-3]))
    )
    here, there = judge_touches(result, touches), judge_touches(shifted, touches)
    np.testing.assert_allclose(there.relative_m, here.relative_m, atol=2e-6)
    assert np.abs(there.error_m - here.error_m).max() > 1e-3


def test_the_table_gives_what_the_touches_were_and_the_command_says_what_it_means(tmp_path: Path) -> None:
    here = world(20)
    result = save_result(here.result, tmp_path / "cal")
    csv = table(tmp_path / "touches.csv", [row(t) for t in here.touches])
    read = read_touches(csv)
    assert [t.feature for t in read] == [t.feature for t in here.touches]
    np.testing.assert_allclose([t.p_BT for t in read], [t.p_BT for t in here.touches], atol=1e-12)
    done = CliRunner().invoke(
        app, ["verify", str(result.parent), "--touch", str(csv), "--out", str(tmp_path / "v"), "--json"]
    )
    said = json.loads(done.stdout.splitlines()[-1])
    wanted = judge_touches(here.result, here.touches)
    assert said["inside"] == wanted.inside.sum()
    np.testing.assert_allclose([t["error_mm"] for t in said["touches"]], 1e3 * wanted.error_m, atol=1e-6)
    assert (tmp_path / "v" / "touch_errors.csv").read_text().count("\n") == 7
    assert CliRunner().invoke(app, ["verify", str(result.parent)]).exit_code == 2


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"feature": "corner"}, "write point, plane, sphere or edge"),
        ({"qw": "2.0"}, "a rotation needs length 1"),
        ({"x": "650", "y": "20", "z": "300"}, "they look like mm"),
        ({"camera_x": "20", "camera_y": "30", "camera_z": "810"}, "they look like mm"),
        ({"tip_z": "195"}, "must be in metres on the flange"),
        ({"feature": "plane", "camera_nx": "", "camera_ny": "", "camera_nz": ""}, "needs its outward normal"),
        ({"feature": "plane", "camera_nx": "0", "camera_ny": "0", "camera_nz": "-2"}, "give a unit vector"),
        ({"feature": "sphere", "feature_radius": ""}, "needs its radius"),
        ({"feature": "point"}, "a ball cannot touch a point"),
        ({"feature": "edge", "cloud": "scan.npy"}, "is not fitted to a cloud"),
        ({"feature": "plane", "cloud": "absent.npy"}, "absent.npy"),
        ({"tip_radius": "two"}, "a number is needed"),
    ],
)  # fmt: skip
def test_each_mistake_in_the_table_is_one_sentence(tmp_path: Path, changes: dict[str, str], said: str) -> None:
    good = row(world(20).touches[0]) | {"feature_radius": "0"}
    with pytest.raises(InputError, match=said):
        judge_touches(world(20).result, read_touches(table(tmp_path / "touches.csv", [good | changes])))


def test_a_table_without_a_column_names_it(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("id,feature\na,point\n")
    with pytest.raises(InputError, match="lacks the columns x, y, z"):
        read_touches(tmp_path / "t.csv")
    with pytest.raises(InputError, match="There is no file"):
        read_touches(tmp_path / "none.csv")
    assert len(REQUIRED) == 16


def test_a_plane_and_a_sphere_come_from_the_cloud_despite_strays(tmp_path: Path) -> None:
    rng, c, R = np.random.default_rng(1), np.array([0.03, -0.02, 0.70]), 12.7e-3
    away = rng.normal(size=(4000, 3))
    away /= np.linalg.norm(away, axis=1)[:, None]
    near = away[away[:, 2] < -0.5]
    scanner = ScannerCorrection(scale=1.002, gradient_per_m=(0.01, 0.0))
    true = c + R * near + 2e-5 * rng.normal(size=near.shape)
    stray = c + [0.0, 0.0, 0.004] + 1e-3 * rng.normal(size=(60, 3))
    seen = np.vstack([true, stray]) / scanner.factor(np.vstack([true, stray]))[:, None]
    found, sigma = fit_touched_sphere(seen, R, scanner)
    assert np.linalg.norm(scanner.points(found) - c) < 2e-5
    assert sigma < 1e-5
    n = np.array([0.1, -0.2, -1.0]) / np.linalg.norm([0.1, -0.2, -1.0])
    a = np.cross(n, [1.0, 0.0, 0.0])
    flat = c + 8e-3 * (rng.uniform(-1, 1, (800, 1)) * a + rng.uniform(-1, 1, (800, 1)) * np.cross(n, a))
    flat += 3e-5 * rng.normal(size=(800, 1)) * n
    cloud = np.vstack([flat, flat[:60] + 2e-3 * n])
    p, normal, _ = fit_touched_plane(cloud)
    assert abs((p - c) @ n) < 1e-5
    assert normal @ n > np.cos(np.radians(0.05))
    np.save(tmp_path / "scan.npy", cloud)
    place = dict(zip(CAMERA, ("0.03", "-0.02", "0.7"), strict=True))
    asked = row(world(20).touches[0]) | place | {"feature": "plane", "cloud": "scan.npy"}
    (read,) = read_touches(table(tmp_path / "touches.csv", [asked]), correction_from_document(None))
    np.testing.assert_allclose(read.direction_C, normal, atol=2e-3)
    with pytest.raises(InputError, match="and 30 are needed"):
        read_touches(table(tmp_path / "touches.csv", [asked | {"camera_z": "0.6"}]))
