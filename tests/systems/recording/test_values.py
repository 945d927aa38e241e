"""Port values as JSON: what is read back is what was written, to the last bit."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw

from weldcal.models.arms.kinematics import ArmModel, load_arm
from weldcal.models.errors import InputError
from weldcal.systems.messages import ScanStream, StreamedScan, UrStatus
from weldcal.systems.recording.values import array, decode, encode, first_difference


def through_a_file(value: object) -> object:
    return json.loads(json.dumps(encode(value), allow_nan=False))


@given(st.lists(st.floats(width=64), max_size=40))
def test_every_number_comes_back(numbers: list[float]) -> None:
    given_array = np.array(numbers)
    assert array(through_a_file(given_array)).tobytes() == given_array.tobytes() or np.isnan(given_array).any()
    np.testing.assert_array_equal(array(through_a_file(given_array)), given_array)


@pytest.mark.parametrize("shape", [(0, 3), (2, 2), (3, 5, 3)])
@pytest.mark.parametrize("kind", [np.float32, np.float64, np.uint8])
def test_an_array_keeps_its_shape_and_type(shape: tuple[int, ...], kind: type) -> None:
    values = (np.random.default_rng(1).uniform(0, 255, shape)).astype(kind)
    found = array(through_a_file(values))
    np.testing.assert_array_equal(found, values)
    assert found.shape == shape


def test_an_arm_with_its_calibration_comes_back() -> None:
    arm = load_arm("ur10e")
    found = decode(through_a_file(arm), ArmModel)
    np.testing.assert_array_equal(found.stack, arm.stack)
    assert found.joint_names == arm.joint_names
    assert found.dh == arm.dh
    assert found.calibration == arm.calibration


def test_messages_come_back() -> None:
    status = UrStatus(safety_mode="PROTECTIVE_STOP", fault="it stopped")
    assert decode(through_a_file(status), UrStatus) == status
    stream = ScanStream((StreamedScan(3, -math.inf, np.full((2, 2, 3), np.nan, np.float32), 1.5, None),))
    (frame,) = decode(through_a_file(stream), ScanStream).frames
    assert (frame.sequence, frame.capture_time, frame.arrival_time, frame.device_time) == (3, -math.inf, 1.5, None)
    np.testing.assert_array_equal(frame.points_C, stream.frames[0].points_C)


def test_what_is_of_another_type_is_refused_in_a_sentence() -> None:
    for wrong in ({"robot_mode": 3}, [1.0], "RUNNING"):
        with pytest.raises(InputError, match=r"holds a UrStatus that cannot be read .*: record the run again\.$"):
            decode(wrong, UrStatus)


@dataclass
class Inner:
    points: np.ndarray = field(default_factory=lambda: np.arange(1000.0))
    X: RigidTransform = field(default_factory=lambda: RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1.0, 2.0, 3.0]))
    names: tuple[str, ...] = ("a", "b")


def test_the_first_difference_is_named_by_its_field() -> None:
    was = encode(Inner())
    assert first_difference(was, encode(Inner())) is None
    moved = encode(Inner(X=RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1.0, 2.0 + 1e-15, 3.0])))
    assert first_difference(was, moved) == ("X.values[7]", 2.0, 2.0 + 4.440892098500626e-16 * 2)
    assert first_difference(was, encode(Inner(names=("a", "c")))) == ("names[1]", "b", "c")


@pytest.mark.parametrize("largest", [None, 500])
def test_a_long_array_of_which_one_number_differs_is_another(largest: int | None) -> None:
    other = np.arange(1000.0)
    other[700] = np.nextafter(700.0, 701.0)
    found = first_difference(encode(Inner(), largest), encode(Inner(other), largest))
    assert found is not None
    assert found[0] == "points"
