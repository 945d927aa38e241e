"""One GenICam device through harvesters: how it is opened and set, its frames, and the components of each frame."""

import glob
import importlib.util
import os
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import as_file, files
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from weldcal.models.documents import read_document
from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import Delivery, DeviceLost, Garbage, Source

BUFFERS = 8
ALIVE_S = 0.3  # between two looks at a device from which no frame is expected
INSTALL = "pip install 'weldcal[genicam]'"
_UNITS = {"Millimeter": 1e-3, "Meter": 1.0, "Inch": 0.0254}
Datum = TypeVar("Datum", bound=NDArray[Any])


def require_harvesters() -> None:
    """Raises InputError, with the line to type, where harvesters or genicam is not installed."""
    for package in ("harvesters", "genicam"):
        if importlib.util.find_spec(package) is None:
            raise InputError(f"A GenICam device needs the package {package}, which is not installed: type {INSTALL}.")


def producer_path(given: str) -> str:
    """The GenTL producer (.cti) of the device's maker: as given, or the only one that GENICAM_GENTL64_PATH leads to.

    Raises:
        InputError: there is no such file, none is named, or there are several.
    """
    if given:
        if not os.path.isfile(given):
            raise InputError(
                f"There is no GenTL producer '{given}': give the path of the .cti file of the device's maker."
            )
        return given
    folders = os.environ.get("GENICAM_GENTL64_PATH", "").split(os.pathsep)
    found = sorted(
        path for folder in folders if folder for path in glob.glob(os.path.join(glob.escape(folder), "*.cti"))
    )
    if len(found) == 1:
        return found[0]
    several = f"several are there: {', '.join(found)}" if found else "GENICAM_GENTL64_PATH leads to none"
    raise InputError(
        f"Write the GenTL producer of the device's maker in the scenario, producer: /path/to/maker.cti ({several})."
    )


@dataclass(kw_only=True)
class GenicamKeys:
    """The keys that every `!Genicam...` driver has."""

    producer: str = ""  # the .cti file; empty: the only one that GENICAM_GENTL64_PATH leads to
    device: str = ""  # serial number, model, name or id; empty: the only one
    profile: str = "generic"  # of profiles.yaml: phoxi, motioncam, genicam_3d, ranger3, generic
    settings: dict[str, str] = field(default_factory=dict)  # features by name, over those of the profile

    def title(self, kind: str) -> str:
        """Return the device's name at the beginning of a sentence."""
        return f"The {kind} {self.device or self.profile} (GenICam)"


@dataclass(frozen=True, eq=False)
class Component:
    """A component of a frame: pixel format by its GenICam name, and values as the device sent them."""

    kind: str
    width: int
    height: int
    values: NDArray[Any]


@dataclass(frozen=True, eq=False)
class CopiedFrame:
    """A frame: components copied out of the buffer, its number, its stamp (s, device's clock; None: none)."""

    components: tuple[Component, ...]
    number: int | None
    device_time: float | None
    arrived: float


class GenicamDevice:
    """A device and its image acquirer. `wanted` is its serial number, model, name or id; empty where there is only one.

    A process opens one device of a producer at a time: to look for devices harvesters closes the producer and opens it
    again.
    """

    def __init__(self, producer: str, wanted: str, features: Mapping[str, str], alive: str = "") -> None:
        require_harvesters()
        self._producer, self._wanted = producer_path(producer), wanted
        self._features, self._alive = dict(features), alive
        self.metres: float | None = None  # of a coordinate's unit; None: the device does not say it
        self.stamped: bool | None = None  # whether its buffers have time stamps; None: not known yet
        self._harvester: Any = None
        self._acquirer: Any = None
        self._looked = 0.0

    @property
    def nodes(self) -> Any:
        """The device's features by name."""
        return self._acquirer.remote_device.node_map

    def open(self) -> None:
        """Find the device, write its features and start. Raises DeviceLost."""
        from harvesters.core import Harvester

        self._harvester = Harvester()
        try:
            self._harvester.add_file(self._producer)
            self._acquirer = self._create(self._harvester)
            self._write()
            self.metres = _UNITS.get(str(self.read("Scan3dDistanceUnit")))
            with suppress(Exception):  # a device may fix the number
                self._acquirer.num_buffers = max(BUFFERS, int(self._acquirer.min_num_buffers))
            self._acquirer.start()
        except BaseException:
            self.close()
            raise

    def take(self, timeout_s: float) -> CopiedFrame | None:
        """Return the oldest frame that waits; None where none came in time.

        Raises DeviceLost, and Garbage for an empty one.
        """
        if self._acquirer is None:
            raise DeviceLost("it is not open")
        buffer = self._acquirer.try_fetch(timeout=timeout_s)
        if buffer is None:
            self._look()
            return None
        arrived = time.monotonic()
        try:
            number = int(buffer.module.frame_id)
            stamp = self._stamp(buffer)
            parts = [
                Component(str(c.data_format), int(c.width), int(c.height), np.array(c.data))
                for c in buffer.payload.components
                if c.width and c.height
            ]
        finally:
            buffer.queue()
        if not parts:
            raise Garbage("it sent a frame without components")
        return CopiedFrame(tuple(parts), number, stamp, arrived)

    def execute(self, command: str) -> None:
        """Run a command of the device. Raises DeviceLost."""
        try:
            self.nodes.get_node(command).execute()
        except Exception as error:
            raise DeviceLost(f"its command {command} failed ({error})") from error

    def read(self, feature: str) -> Any:
        """Return the value of a feature; None where the device has none of this name."""
        try:
            return self.nodes.get_node(feature).value
        except Exception:  # the producers' bindings raise types of their own, of no common base
            return None

    def close(self) -> None:
        """Stop and let the device go; a second call has no effect."""
        self._destroy()
        if self._harvester is not None:
            with suppress(Exception):
                self._harvester.reset()
            self._harvester = None

    def _create(self, harvester: Any) -> Any:
        with suppress(Exception):  # a producer that cannot look again still has the devices of its last look
            harvester.update()
        listed = [info.property_dict for info in harvester.device_info_list]
        keys = ("serial_number", "model", "user_defined_name", "id_")
        fitting = [
            k for k, found in enumerate(listed) if not self._wanted or self._wanted in [found.get(n) for n in keys]
        ]
        if len(fitting) != 1:
            names = ", ".join(f"{found.get('model')} {found.get('serial_number')}" for found in listed) or "none"
            many = "several devices fit" if fitting else "no such device answers"
            raise DeviceLost(f"{many} (there are: {names}); give the serial number of one that is switched on")
        try:
            return harvester.create(fitting[0])
        except Exception as error:
            raise DeviceLost(f"it cannot be opened, perhaps because another program uses it ({error})") from error

    def _write(self) -> None:
        for name, value in self._features.items():
            try:
                self.nodes.get_node(name).from_string(value)
            except Exception as error:
                known = "has no feature" if not self._has(name) else f"does not accept '{value}' for its feature"
                raise DeviceLost(f"it {known} {name}: correct it in the scenario's settings ({error})") from error

    def _has(self, name: str) -> bool:
        return bool(self.nodes.has_node(name))

    def _stamp(self, buffer: Any) -> float | None:
        if self.stamped is False:
            return None
        try:
            stamp = 1e-9 * float(buffer.module.timestamp_ns)
        except Exception:  # NotAvailableException: this device has no stamps
            self.stamped = False
            return None
        self.stamped = True
        return stamp

    def _look(self) -> None:
        """Notice a device that is gone though no frame is expected of it."""
        now = time.monotonic()
        if not self._alive or now - self._looked < ALIVE_S:
            return
        self._looked = now
        if self.read(self._alive) in (None, False):
            raise DeviceLost("it does not answer any more: look at its power and its cable")

    def _destroy(self) -> None:
        if self._acquirer is not None:
            with suppress(Exception):  # of a device that is gone nothing can be stopped
                self._acquirer.stop()
            with suppress(Exception):
                self._acquirer.destroy()
            self._acquirer = None


class GenicamSource(Source[Datum]):
    """A device as a source. `trigger` is the command that takes a frame; empty: the device runs freely."""

    def __init__(self, device: GenicamDevice, title: str, trigger: str = "") -> None:
        self.device, self.name, self._trigger = device, title, trigger
        self._request, self._skip = 0, 0

    @abstractmethod
    def datum(self, components: tuple[Component, ...]) -> Datum:
        """Return the datum of a frame's components. Raises Garbage."""

    def open(self) -> None:
        """See Source."""
        self.device.open()

    def ask(self, request: int) -> None:
        """See Source."""
        while self.device.take(0.001) is not None:  # frames of before the request
            pass
        self._request = request
        if self._trigger:
            self.device.execute(self._trigger)
        else:
            self._skip = 1  # the frame whose exposure was under way

    def next(self, timeout_s: float) -> Delivery[Datum] | None:
        """See Source."""
        taken = self.device.take(timeout_s)
        if taken is None:
            return None
        if self._skip:
            self._skip -= 1
            return None
        try:
            datum = self.datum(taken.components)
        except Garbage as error:
            raise Garbage(f"in frame {taken.number}: {error}") from error
        return Delivery(
            datum=datum,
            arrived=taken.arrived,
            device_time=taken.device_time,
            number=taken.number,
            request=self._request,
        )

    def close(self) -> None:
        """See Source."""
        self.device.close()


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
        """Return every feature to write, in order; the scenario's own replace those of the profile."""
        return {**self.settings, **(self.stream if streams else self.scans), **own}


@cache
def profiles() -> dict[str, DeviceProfile]:
    """Return all profiles by name."""
    with as_file(files(__package__).joinpath("profiles.yaml")) as path:
        document = read_document(path)
    return {name: replace(DeviceProfile(), **keys) for name, keys in document.items()}


def get_profile(name: str) -> DeviceProfile:
    """Return the named profile; raises InputError naming the known ones."""
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
    """Return the last line of a frame as points (W, 2) [x, z] in the device's unit, NaN where nothing was measured.

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
    """Return the first picture of a frame in grey (H, W), 8 bits.

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
