"""One GenICam device through harvesters: opened by its serial number, model or name, with features as data."""

import glob
import importlib.util
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weldcal.models.errors import InputError
from weldcal.systems.drivers.sensors.acquisition import DeviceLost, Garbage

BUFFERS = 8
ALIVE_S = 0.3  # between two looks at a device from which no frame is expected
INSTALL = "pip install 'weldcal[genicam]'"
_UNITS = {"Millimeter": 1e-3, "Meter": 1.0, "Inch": 0.0254}


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


@dataclass(frozen=True, eq=False)
class Component:
    """A component of a frame: pixel format by its GenICam name, and values as the device sent them."""

    kind: str
    width: int
    height: int
    values: NDArray[Any]


@dataclass(frozen=True, eq=False)
class CopiedFrame:
    """A frame: components copied out of the buffer, its number, its stamp (s of the device's clock; None: it has
    none)."""

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
        """The oldest frame that waits; None where none came in time.

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
        """The value of a feature; None where the device has none of this name."""
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
