"""Convert port values to JSON, and point clouds and images to CDR, without loss of a bit."""

from __future__ import annotations

import base64
import dataclasses as dc
import enum
import math
import struct
import types
import typing
from hashlib import sha256
from pathlib import PurePath
from typing import Any, Final

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from weldcal.models.errors import InputError

LISTED = 16  # numbers of an array that is written as a list; a longer one is written in base64
_NOT_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_DEEPEST = 12
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


def encode(value: Any, largest: int | None = None, depth: int = 0) -> Any:
    """A value as JSON has it: numbers that are not finite as text, arrays with shape and type, objects by their fields.

    An array of more than `largest` numbers is replaced by its SHA-256, which tells whether it is the same.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, np.ndarray):
        return _array(value, largest)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return _number(float(value))
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, RigidTransform):
        return _array(value.GetAsMatrix34())
    if isinstance(value, RotationMatrix):
        return _array(value.matrix())
    if isinstance(value, PurePath):
        return value.name
    if depth > _DEEPEST:
        raise TypeError(f"a {type(value).__name__} is nested too deeply to be recorded")
    if isinstance(value, list | tuple):
        return [encode(item, largest, depth + 1) for item in value]
    if isinstance(value, dict):
        return {str(key): encode(item, largest, depth + 1) for key, item in value.items()}
    if dc.is_dataclass(value):
        return {f.name: encode(getattr(value, f.name), largest, depth + 1) for f in dc.fields(value)}
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
    names = [*getattr(value, "__dict__", {}), *(n for n in slots if hasattr(value, n))]
    found = {name: getattr(value, name) for name in names}
    return {name: encode(item, largest, depth + 1) for name, item in found.items() if not callable(item)}


def _number(value: float) -> float | str:
    if math.isfinite(value):
        return value
    return "NaN" if math.isnan(value) else "Infinity" if value > 0.0 else "-Infinity"


def _array(value: np.ndarray, largest: int | None = None) -> Any:
    if value.size <= LISTED and value.dtype == np.float64:
        found = [_number(x) for x in value.ravel().tolist()]
        return found if value.ndim == 1 else {"shape": list(value.shape), "values": found}
    if largest is not None and value.size > largest:
        digest = sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"shape": list(value.shape), "dtype": value.dtype.str, "sha256": digest}
    data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode("ascii")
    return {"shape": list(value.shape), "dtype": value.dtype.str, "base64": data}


def decode(value: Any, kind: Any) -> Any:
    """Return the value of a type hint from what `encode` wrote.

    Raises:
        InputError: the value is not of this type.
    """
    try:
        return _decode(value, kind)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        name = getattr(kind, "__name__", str(kind))
        raise InputError(
            f"The recording holds a {name} that cannot be read ({error}): record the run again."
        ) from error


def _decode(value: Any, kind: Any) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _decode(value, next(a for a in arguments if a is not type(None)))
    if origin is np.ndarray or kind is np.ndarray:
        return array(value)
    if origin is tuple:
        each = arguments[0]
        return tuple(_decode(v, each if arguments[-1] is Ellipsis else arguments[k]) for k, v in enumerate(value))
    if origin is list:
        return [_decode(v, arguments[0]) for v in value]
    if kind is float:
        return _NOT_FINITE[value] if isinstance(value, str) else float(value)
    if kind is RigidTransform:
        return RigidTransform(array(value))
    if dc.is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, dict):
            raise TypeError("expected its fields by name")
        hints = typing.get_type_hints(kind)
        return kind(**{f.name: _decode(value[f.name], hints[f.name]) for f in dc.fields(kind) if f.name in value})
    if kind in (int, str, bool):
        if not isinstance(value, kind):
            raise TypeError(f"expected {kind.__name__}")
        return value
    raise TypeError(f"no rule for {kind}")


def array(value: Any) -> np.ndarray:
    """Return the array that `encode` wrote; read-only."""
    if isinstance(value, list):
        found = np.array([_NOT_FINITE[x] if isinstance(x, str) else x for x in value], dtype=np.float64)
    elif "values" in value:
        found = array(value["values"]).reshape(value["shape"])
    else:
        found = np.frombuffer(base64.b64decode(value["base64"]), dtype=np.dtype(value["dtype"])).reshape(value["shape"])
    found.flags.writeable = False
    return found


def first_difference(was: Any, now: Any, path: str = "") -> tuple[str, Any, Any] | None:
    """Where two encoded values differ first: the path of the field and both values; None where they are the same."""
    if isinstance(was, dict) and isinstance(now, dict):
        for key in [*was, *(k for k in now if k not in was)]:
            found = first_difference(was.get(key), now.get(key), f"{path}.{key}" if path else key)
            if found is not None:
                return found
        return None
    if isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
        for k, (a, b) in enumerate(zip(was, now, strict=True)):
            found = first_difference(a, b, f"{path}[{k}]")
            if found is not None:
                return found
        return None
    if was == now and type(was) is type(now):
        return None
    field = path.rpartition(".")[2]
    if field in ("base64", "sha256"):
        return path.removesuffix(field).rstrip("."), "an array", "an array of other numbers"
    return path, was, now


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
    """Return an organised cloud (H, W, 3), NaN where there is no point, as sensor_msgs/msg/PointCloud2.

    The numbers are float32 or float64.
    """
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
    """Return the cloud that write_cloud wrote; read-only."""
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
    """Return a grey image (H, W) uint8 as sensor_msgs/msg/Image, mono8."""
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
    """Return the image that write_image wrote; read-only."""
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
