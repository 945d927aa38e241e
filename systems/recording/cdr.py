"""Writes and reads ROS 2 point clouds and images as CDR, the encoding that ROS and Foxglove read."""

from __future__ import annotations

import math
import struct
from typing import Any, Final

import numpy as np

from weldcal.models.errors import InputError

POINT_CLOUD: Final = "sensor_msgs/msg/PointCloud2"
IMAGE: Final = "sensor_msgs/msg/Image"
_HEADER = """================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
SCHEMAS: Final = {
    POINT_CLOUD: (
        f"""std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
{_HEADER}================================================================================
MSG: sensor_msgs/PointField
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
"""
    ),
    IMAGE: (
        f"""std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
{_HEADER}"""
    ),
}
_FLOATS: Final[dict[np.dtype[Any], int]] = {np.dtype(np.float32): 7, np.dtype(np.float64): 8}


class _Out:
    """Bytes under construction, each number at a multiple of its size."""

    def __init__(self) -> None:
        self.parts = bytearray(b"\x00\x01\x00\x00")  # little-endian CDR

    def number(self, form: str, value: int) -> None:
        size = struct.calcsize(form)
        self.parts += b"\x00" * (-(len(self.parts) - 4) % size) + struct.pack("<" + form, value)

    def text(self, value: str) -> None:
        data = value.encode() + b"\x00"
        self.number("I", len(data))
        self.parts += data

    def header(self, time_ns: int, frame: str) -> None:
        self.number("i", time_ns // 10**9)
        self.number("I", time_ns % 10**9)
        self.text(frame)

    def data(self, array: np.ndarray) -> None:
        self.number("I", array.nbytes)
        self.parts += np.ascontiguousarray(array).reshape(-1).view(np.uint8).data


class _In:
    """The counterpart of _Out."""

    def __init__(self, data: bytes) -> None:
        if data[:2] != b"\x00\x01":
            raise InputError("The recording holds a message that is no little-endian CDR: record the run again.")
        self.bytes, self.at = data, 4

    def number(self, form: str) -> int:
        size = struct.calcsize(form)
        self.at += -(self.at - 4) % size
        (value,) = struct.unpack_from("<" + form, self.bytes, self.at)
        self.at += size
        return int(value)

    def text(self) -> str:
        size = self.number("I")
        found = self.bytes[self.at : self.at + size - 1].decode()
        self.at += size
        return found

    def header(self) -> None:
        self.number("i")
        self.number("I")
        self.text()

    def data(self) -> bytes:
        size = self.number("I")
        found = self.bytes[self.at : self.at + size]
        self.at += size
        return found


def write_cloud(points: np.ndarray, time_ns: int, frame: str) -> bytearray:
    """An organised cloud (H, W, 3) of float32 or float64, NaN where there is no point, as
    sensor_msgs/msg/PointCloud2."""
    out, kind = _Out(), _FLOATS[points.dtype]
    step = 3 * points.dtype.itemsize
    out.header(time_ns, frame)
    out.number("I", points.shape[0])
    out.number("I", points.shape[1])
    out.number("I", 3)
    for k, name in enumerate("xyz"):
        out.text(name)
        out.number("I", k * points.dtype.itemsize)
        out.number("B", kind)
        out.number("I", 1)
    out.number("?", False)
    out.number("I", step)
    out.number("I", step * points.shape[1])
    out.data(points)
    out.number("?", False)
    return out.parts


def read_cloud(data: bytes) -> np.ndarray:
    """The cloud that write_cloud wrote; read-only."""
    given = _In(data)
    given.header()
    height, width = given.number("I"), given.number("I")
    kind = 7
    for _ in range(given.number("I")):
        given.text()
        given.number("I")
        kind = given.number("B")
        given.number("I")
    given.number("?")
    given.number("I")
    given.number("I")
    dtype = next(d for d, k in _FLOATS.items() if k == kind)
    return _shaped(given.data(), dtype, (height, width, 3))


def write_image(pixels: np.ndarray, time_ns: int, frame: str) -> bytearray:
    """A grey image (H, W) uint8 as sensor_msgs/msg/Image, mono8."""
    out = _Out()
    out.header(time_ns, frame)
    out.number("I", pixels.shape[0])
    out.number("I", pixels.shape[1])
    out.text("mono8")
    out.number("B", 0)
    out.number("I", pixels.shape[1])
    out.data(pixels)
    return out.parts


def read_image(data: bytes) -> np.ndarray:
    """The image that write_image wrote; read-only."""
    given = _In(data)
    given.header()
    height, width = given.number("I"), given.number("I")
    given.text()
    given.number("B")
    given.number("I")
    return _shaped(given.data(), np.dtype(np.uint8), (height, width))


def _shaped(data: bytes, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    if len(data) != dtype.itemsize * math.prod(shape):
        raise InputError(
            "The recording holds a cloud or an image whose size contradicts its header: record the run again."
        )
    return np.frombuffer(data, dtype=dtype).reshape(shape)
