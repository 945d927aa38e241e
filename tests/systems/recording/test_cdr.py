"""Clouds and images as ROS 2 messages: their bytes are laid out as CDR has it."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from weldcal.models.errors import InputError
from weldcal.systems.recording.values import read_cloud, read_image, write_cloud, write_image

CLOUD = np.arange(18, dtype=np.float32).reshape(2, 3, 3)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_cloud_comes_back(kind: type) -> None:
    points = CLOUD.astype(kind)
    points[0, 1] = np.nan
    found = read_cloud(write_cloud(points, 12_345_678_901, "camera"))
    assert found.dtype == kind
    np.testing.assert_array_equal(found, points)
    assert read_cloud(write_cloud(np.empty((0, 0, 3), kind), 0, "camera")).shape == (0, 0, 3)


@pytest.mark.parametrize("frame", ["c", "camera", "finger_camera"])
def test_an_image_comes_back(frame: str) -> None:
    pixels = np.arange(15, dtype=np.uint8).reshape(3, 5)
    np.testing.assert_array_equal(read_image(write_image(pixels, 5, frame)), pixels)


def test_every_number_lies_at_a_multiple_of_its_size() -> None:
    """By hand from the rules of CDR: 4 bytes of encapsulation, then offsets count from 0."""
    data = write_cloud(CLOUD, 3_000_000_007, "cam")[4:]
    assert struct.unpack_from("<iI", data, 0) == (3, 7)
    assert struct.unpack_from("<I4s", data, 8) == (4, b"cam\x00")
    assert struct.unpack_from("<III", data, 16) == (2, 3, 3)  # height, width, number of fields
    assert struct.unpack_from("<I2sxxIBxxxI", data, 28) == (2, b"x\x00", 0, 7, 1)
    assert struct.unpack_from("<I2sxxIBxxxI", data, 48) == (2, b"y\x00", 4, 7, 1)
    assert struct.unpack_from("<I2sxxIBxxxI", data, 68) == (2, b"z\x00", 8, 7, 1)
    assert struct.unpack_from("<?xxxIII", data, 88) == (False, 12, 36, 72)
    assert data[104:176] == CLOUD.tobytes()
    assert data[176:] == b"\x00"


def test_a_message_whose_size_contradicts_itself_is_refused() -> None:
    data = bytearray(write_cloud(CLOUD, 0, "cam"))
    struct.pack_into("<I", data, 4 + 16, 200)
    with pytest.raises(InputError, match="size contradicts its header"):
        read_cloud(bytes(data))
