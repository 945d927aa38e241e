"""A plate is found anywhere in the scan without a guess, with an honest covariance, or refused with the reason."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from tests.worlds.parts.scans import Scene, box, looking_at, scan_part, table
from weldcal.models.errors import InputError
from weldcal.models.scanners import cast, get_scanner
from weldcal.models.workpieces.plate import make_workpiece
from weldcal.welding.locate.find_workpiece import AmbiguousWorkpiece, FoundWorkpiece, find_workpiece
from weldcal.welding.locate.registration import WorkpieceNotFound

SCANNER = get_scanner("phoxi_m", 515, 385)
CAD = {shape: make_workpiece(shape) for shape in ("straight", "s", "l")}


def _turn(X: RigidTransform) -> float:
    x = X.rotation().matrix()[:, 0]
    return math.atan2(x[1], x[0])


def _error(found: FoundWorkpiece, truth: RigidTransform) -> tuple[np.ndarray, float]:
    """The motion (6,) that leads to the truth, rotation then translation, and its square in sigmas."""
    E = found.X_BP.InvertAndCompose(truth)
    turn = E.rotation().ToAngleAxis()
    v = np.concatenate([turn.axis() * turn.angle(), E.translation()])
    return v, float(v @ np.linalg.solve(found.registration.covariance, v))


def _found(scene: Scene, off_deg: float = 70.0) -> FoundWorkpiece:
    hint = _turn(scene.X_BP) + math.radians(off_deg)
    return find_workpiece(scene.cloud_B, scene.part, turn_hint_rad=hint, eye_B=scene.eye_B)


def test_parts_in_any_turn_and_tilted_up_to_15_degrees_are_found_and_their_covariance_holds() -> None:
    squares = []
    for seed, shape in ((3001, "straight"), (3002, "s"), (3003, "l")):
        scene = scan_part(CAD[shape], SCANNER, seed, tilt_rad=math.radians(15.0))
        found = _found(scene)
        v, square = _error(found, scene.X_BP)
        squares.append(square)
        # A pixel is 1.6 mm here and the faces lean by up to 20 degrees to the sight.
        assert np.linalg.norm(v[3:]) < 0.5e-3
        assert np.linalg.norm(v[:3]) < math.radians(0.12)
        assert found.confidence > 0.85
    # Chi square of 18 degrees of freedom: below 35 with 99 %.
    assert 2.0 < sum(squares) < 34.8


def test_an_l_groove_tells_its_own_turn_without_any_hint() -> None:
    scene = scan_part(CAD["l"], SCANNER, 3010)
    found = find_workpiece(scene.cloud_B, CAD["l"])
    v, _ = _error(found, scene.X_BP)
    assert np.linalg.norm(v[:3]) < math.radians(0.1)
    assert "groove tells" in found.summary
    assert found.groove is not None
    assert found.groove > 0.8


def test_a_part_that_looks_the_same_turned_round_is_a_question_until_a_hint_answers_it() -> None:
    scene = scan_part(CAD["s"], SCANNER, 3011)
    with pytest.raises(AmbiguousWorkpiece, match="looks the same turned by 180 deg"):
        find_workpiece(scene.cloud_B, CAD["s"])
    with pytest.raises(AmbiguousWorkpiece, match="square to the guess"):
        _found(scene, 90.0)
    there, turned = _found(scene, 60.0), _found(scene, 240.0)
    assert _error(there, scene.X_BP)[0][2] == pytest.approx(0.0, abs=math.radians(0.1))
    # Half a turn between the two answers, about the same middle.
    half = there.X_BP.InvertAndCompose(turned.X_BP)
    assert abs(abs(_turn(half)) - math.pi) < 1e-6
    assert half.translation() == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


def test_clutter_and_an_arm_over_the_part_cost_confidence_and_not_the_place() -> None:
    bare = scan_part(CAD["l"], SCANNER, 3012)
    p = bare.X_BP.translation()
    others = [
        box(0.12, 0.5, 0.09).transformed(bare.X_BP @ RigidTransform(RollPitchYaw(0, 0, 0.3), [0.03, 0.19, 0.15])),
        box(0.10, 0.06, 0.04).transformed(RigidTransform(RollPitchYaw(0, 0, 0.4), [p[0] + 0.25, p[1] + 0.05, 0.0])),
        box(0.25, 0.15, 0.02).transformed(RigidTransform(RollPitchYaw(0, 0, 1.0), [p[0] - 0.1, p[1] - 0.29, 0.0])),
    ]
    scene = scan_part(CAD["l"], SCANNER, 3012, others=others)
    found = _found(scene)
    v, square = _error(found, scene.X_BP)
    assert np.linalg.norm(v[3:]) < 0.5e-3
    assert square < 16.8  # 99 % of chi square with 6 degrees of freedom
    assert 0.4 < found.confidence < 0.85


@pytest.mark.parametrize(
    ("real", "reason"),
    [
        (CAD["l"], "disagree|size"),
        (make_workpiece("s", length_m=0.315, width_m=0.21), "disagree"),
        (make_workpiece("straight", length_m=CAD["s"].size_m[0]), "its groove is not where the drawing has one"),
    ],
    ids=["an l for an s", "5 percent larger", "another groove"],
)
def test_a_wrong_workpiece_is_refused(real: object, reason: str) -> None:
    scene = scan_part(real, SCANNER, 3013)  # type: ignore[arg-type]
    with pytest.raises(WorkpieceNotFound, match=reason):
        find_workpiece(scene.cloud_B, CAD["s"], turn_hint_rad=_turn(scene.X_BP))


def test_two_of_the_same_part_are_a_question() -> None:
    places = [RigidTransform(RollPitchYaw(0, 0, yaw), [0.6, y, 0.02]) for yaw, y in ((0.2, -0.13), (0.4, 0.15))]
    X_BC = looking_at(np.array([0.62, 0.0, 0.97]), np.array([0.6, 0.0, 0.0]))
    cloud = cast([CAD["s"].mesh.transformed(X) for X in places] + [table()], X_BC, SCANNER, seed=4)
    with pytest.raises(AmbiguousWorkpiece, match="Two places"):
        find_workpiece(cloud, CAD["s"], turn_hint_rad=0.2)


def test_scans_without_a_part_are_refused() -> None:
    with pytest.raises(InputError, match="shape"):
        find_workpiece(np.zeros((5, 4)), CAD["s"])
    with pytest.raises(WorkpieceNotFound, match="only 0 points"):
        find_workpiece(np.full((9, 9, 3), np.nan), CAD["s"])
