"""Lists whose rows do not pair in order are paired by the angles of their motions, or refused with the rows named."""

from __future__ import annotations

import re
from collections import Counter

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.calibration.hand_eye.unsorted_sets import judged, unsorted_set
from weldcal.calibration.data.poses.listing import listing_of_array
from weldcal.calibration.data.poses.readings import PoseReading
from weldcal.calibration.errors import DatasetError, InconsistentPoses
from weldcal.calibration.geometry.se3 import inverse, pose
from weldcal.calibration.hand_eye.pairs import conventions
from weldcal.calibration.hand_eye.pairs.importing import ImportedPairs, StatedForms, import_pairs
from weldcal.models.arrays import Array

RNG = np.random.default_rng(8)
N = 12
ROBOT = pose(Rotation.from_rotvec(0.7 * RNG.normal(size=(N, 3))).as_matrix(), RNG.uniform(0.2, 0.8, (N, 3)))
X = pose(Rotation.from_rotvec([0.3, 1.1, -0.4]).as_matrix(), np.array([0.05, -0.02, 0.1]))
CAMERA = inverse(ROBOT @ X) @ pose(np.eye(3), np.array([0.5, 0.1, 0.0]))
OTHER = pose(Rotation.random(3, rng=RNG).as_matrix(), RNG.uniform(0.2, 0.8, (3, 3)))


def paired(robot: Array, camera: Array) -> ImportedPairs:
    lists = [listing_of_array("robot", robot), listing_of_array("camera", camera)]
    return import_pairs(lists, "the set", "eye_in_hand", StatedForms())


def rows(found: ImportedPairs) -> list[tuple[int, int]]:
    return [(int(a), int(b)) for a, b in zip(*found.rows, strict=True)]


def test_of_seventy_generated_sets_none_is_accepted_wrong() -> None:
    sets = [unsorted_set(np.random.default_rng([3, k])) for k in range(70)]
    counts = Counter((one.determined, judged(one)[0]) for one in sets)
    assert counts[True, "WRONG"] + counts[False, "WRONG"] == 0
    determined = sum(count for (sure, _), count in counts.items() if sure)
    assert determined > 25
    assert counts[True, "right"] >= 0.97 * determined


def test_a_shuffled_list_is_ordered_and_the_rows_are_said() -> None:
    order = np.random.default_rng(1).permutation(N)
    found = paired(ROBOT, CAMERA[order])
    assert rows(found) == [(int(k), int(np.flatnonzero(order == k)[0])) for k in range(N)]
    first = int(np.flatnonzero(order == 0)[0]) + 1
    assert f"The rows of 'camera' belong to others of 'robot': {first} to 1," in found.notes[0]
    assert found.robot @ X @ found.camera == pytest.approx(np.tile(ROBOT[0] @ X @ CAMERA[0], (N, 1, 1)), abs=1e-9)


def test_a_reversed_list_is_named() -> None:
    found = paired(ROBOT, CAMERA[::-1])
    assert "'camera' are in reverse order. The angles of the motions show it." in found.notes[0]


def test_rows_without_a_partner_are_named_on_both_sides() -> None:
    found = paired(np.delete(ROBOT, 3, axis=0), np.concatenate([CAMERA[:6], OTHER[:2], CAMERA[6:]]))
    assert rows(found) == [
        *((k, k) for k in range(3)),
        *((k - 1, k) for k in (4, 5)),
        *((k - 1, k + 2) for k in range(6, N)),
    ]
    assert "No partner: rows 4, 7, 8 of 'camera'." in found.notes[0]


def test_home_at_both_ends_has_no_partner() -> None:
    found = paired(np.concatenate([OTHER[:1], ROBOT, OTHER[:1]]), CAMERA)
    assert rows(found) == [(k + 1, k) for k in range(N)]
    assert "No partner: rows 1, 14 of 'robot'." in found.notes[0]


def test_a_row_with_two_possible_partners_is_refused_by_name() -> None:
    noise = Rotation.from_rotvec(np.radians(0.5) * RNG.normal(size=(N, 3))).as_matrix()
    robot = ROBOT.copy()
    robot[7] = robot[2] @ pose(Rotation.from_rotvec([0.002, 0.0, 0.0]).as_matrix(), np.array([1e-4, 0.0, 0.0]))
    camera = inverse(robot @ X) @ pose(noise, np.array([0.5, 0.1, 0.0]) + 1e-3 * RNG.normal(size=(N, 3)))
    with pytest.raises(InconsistentPoses, match=re.escape("all but rows 3, 8 of 'robot'. Number the rows")):
        paired(robot, camera[::-1])


def test_lists_of_other_motions_keep_their_refusal() -> None:
    strange = pose(Rotation.random(N, rng=RNG).as_matrix(), RNG.uniform(0.2, 0.8, (N, 3)))
    with pytest.raises(DatasetError, match="remove what has no partner"):
        paired(ROBOT[:-1], strange)


def test_a_list_in_order_is_not_touched() -> None:
    found = paired(ROBOT, CAMERA)
    assert rows(found) == [(k, k) for k in range(N)]
    assert not any("order" in note for note in found.notes)


@pytest.mark.parametrize("eye_in_hand", [True, False])
def test_the_angles_of_motions_are_the_same_in_both_lists(eye_in_hand: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Array] = []
    monkeypatch.setattr(conventions, "find_order", lambda ours, theirs, *_: given.extend([ours[0], theirs[0]]))
    robot = ROBOT if eye_in_hand else inverse(ROBOT)
    conventions.order_of([PoseReading("", "", robot)], [PoseReading("", "", CAMERA)], eye_in_hand=eye_in_hand)
    assert given[0] == pytest.approx(given[1], abs=1e-6)
    assert given[0].max() > 1.0
