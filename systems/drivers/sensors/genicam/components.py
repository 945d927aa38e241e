"""Components of GenICam frames as clouds, profiles and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.models.documents import read_document
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Garbage
from weldcal.systems.drivers.sensors.genicam.device import Component


@dataclass(frozen=True)
class DeviceProfile:
    """What profiles.yaml says of one kind of device."""

    settings: dict[str, str] = field(default_factory=dict)
    scans: dict[str, str] = field(default_factory=dict)
    stream: dict[str, str] = field(default_factory=dict)
    trigger: str = ""
    alive: str = ""
    unit: str = "device"

    def features(self, *, streams: bool, own: dict[str, str]) -> dict[str, str]:
        """Every feature to write, in order; the scenario's own replace those of the profile."""
        return {**self.settings, **(self.stream if streams else self.scans), **own}


@cache
def profiles() -> dict[str, DeviceProfile]:
    """All profiles by name."""
    with as_file(files(__package__).joinpath("profiles.yaml")) as path:
        document = read_document(path)
    return {name: replace(DeviceProfile(), **keys) for name, keys in document.items()}


def get_profile(name: str) -> DeviceProfile:
    """The named profile; raises InputError naming the known ones."""
    found = profiles().get(name)
    if found is None:
        raise InputError(f"There is no GenICam profile '{name}': use one of {', '.join(profiles())}.")
    return found


Scaling = tuple[tuple[float, float], tuple[float, float]]
"""Scale and offset of coordinates A and C."""

UNIT_SCALING: Scaling = ((1.0, 0.0), (1.0, 0.0))
_GREY = ("Mono8", "BayerRG8", "BayerGR8", "BayerGB8", "BayerBG8")
_COLOURS = {"RGB8": (0, 1, 2), "BGR8": (2, 1, 0), "RGBa8": (0, 1, 2), "BGRa8": (2, 1, 0)}
_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
_DEEP = {"Mono10": 2, "Mono12": 4, "Mono14": 6, "Mono16": 8}


def cloud_of(parts: Sequence[Component]) -> NDArray[np.float32]:
    """Points (H, W, 3) in the device's unit, of Coord3D_ABC32f or its planes; other components are left out.

    Raises:
        Garbage: the frame has no such component.
    """
    for part in parts:
        if part.kind == "Coord3D_ABC32f":
            return _shaped(part, 3)
        if part.kind == "Coord3D_ABC32f_Planar":
            return np.ascontiguousarray(np.moveaxis(_flat(part, 3).reshape(3, part.height, part.width), 0, -1))
    planes = {part.kind: part for part in parts}
    found = [planes.get(f"Coord3D_{axis}32f") for axis in "ABC"]
    if any(plane is None for plane in found):
        raise Garbage(f"its frames have {_kinds(parts)} and no Coord3D_ABC32f: let it send its point cloud")
    return np.stack([_shaped(plane, 1)[..., 0] for plane in found if plane is not None], axis=-1)


def profile_of(parts: Sequence[Component], scaling: Scaling = UNIT_SCALING) -> NDArray[np.float64]:
    """The last line of a frame as points (W, 2) [x, z] in the device's unit, NaN where nothing was measured.

    Of Coord3D_AC32f, Coord3D_ABC32f or its planes as they are; of the range Coord3D_C16, whose x is the column, by
    `scaling`.

    Raises:
        Garbage: the frame has no such component.
    """
    for part in parts:
        if part.kind == "Coord3D_AC32f":
            return _with_gaps(_shaped(part, 2)[-1].astype(np.float64))
        if part.kind in ("Coord3D_C16", "Coord3D_C32f", "Coord3D_C8") and not _has_x(parts):
            (scale_a, offset_a), (scale_c, offset_c) = scaling
            raw = _shaped(part, 1)[-1, :, 0].astype(np.float64)
            z = np.where(raw == 0.0, np.nan, scale_c * raw + offset_c)
            return np.column_stack([scale_a * np.arange(part.width) + offset_a, z])
    return _with_gaps(cloud_of(parts)[-1][:, [0, 2]].astype(np.float64))


def picture_of(parts: Sequence[Component]) -> NDArray[np.uint8]:
    """The first picture of a frame in grey (H, W), 8 bits.

    Raises:
        Garbage: the frame has no picture in a known pixel format.
    """
    for part in parts:
        if part.kind in _GREY:
            return np.asarray(_shaped(part, 1)[..., 0], dtype=np.uint8)
        if part.kind in _DEEP:
            return np.asarray(_shaped(part, 1)[..., 0] >> _DEEP[part.kind], dtype=np.uint8)
        if part.kind in _COLOURS:
            colours = _shaped(part, 4 if "a" in part.kind else 3)
            rgb = colours[..., list(_COLOURS[part.kind])].astype(np.float32)
            return np.asarray(np.rint(rgb @ _LUMINANCE), dtype=np.uint8)
    raise Garbage(f"its frames have {_kinds(parts)} and no picture in Mono8 or RGB8: set its PixelFormat to Mono8")


def _has_x(parts: Sequence[Component]) -> bool:
    return any(part.kind in ("Coord3D_A32f", "Coord3D_ABC32f", "Coord3D_ABC32f_Planar") for part in parts)


def _with_gaps(points: NDArray[np.float64]) -> NDArray[np.float64]:
    points[~(np.abs(points[:, 1]) > 0.0)] = np.nan
    return points


def _flat(part: Component, channels: int) -> NDArray[Any]:
    values = part.values.reshape(-1)
    if values.size != part.width * part.height * channels:
        raise Garbage(f"its {part.kind} has {values.size} values, not {part.width} x {part.height} x {channels}")
    return values


def _shaped(part: Component, channels: int) -> NDArray[Any]:
    return _flat(part, channels).reshape(part.height, part.width, channels)


def _kinds(parts: Sequence[Component]) -> str:
    return ", ".join(part.kind for part in parts) or "no components"
