"""Finds drivers: those of weldcal by their names, and modules that installed packages register as entry points."""

import importlib
import inspect
from functools import cache
from importlib.metadata import entry_points
from types import ModuleType
from typing import get_type_hints

from weldcal.models.errors import InputError
from weldcal.systems.drivers.config import DriverConfig, NoDevice

ENTRY_POINTS = "weldcal.drivers"
OWN = {
    "FolderProfiler": "sensors.folder_profiler",
    "FolderScanner": "sensors.folder_scanner",
    "GenicamFingerCamera": "sensors.genicam.finger_camera",
    "GenicamProfiler": "sensors.genicam.profiler",
    "GenicamScanner": "sensors.genicam.scanner",
    "ModbusPowerSource": "power.modbus",
    "RealSense": "sensors.realsense",
    "RenderedFingerCamera": "simulated.rendered_finger_camera",
    "RenderedProfiler": "simulated.rendered_profiler",
    "RenderedScanner": "simulated.rendered_scanner",
    "RenderedWristCamera": "simulated.rendered_wrist_camera",
    "SimulatedPowerSource": "simulated.power_source",
    "SimulatedTablet": "simulated.tablet_world",
    "SimulatedUr": "simulated.ur",
    "StreamingScanner": "simulated.streaming_scanner",
    "UrRtde": "ur.rtde",
    "UrTouchProbe": "ur.touch_probe",
    "VideoFingerCamera": "sensors.video_finger_camera",
}
"""The modules of weldcal's own drivers, below weldcal.systems.drivers, by the tag in a scenario."""
DEFAULTS = frozenset({"RenderedFingerCamera", "RenderedScanner", "SimulatedUr"})
"""Those with a DEFAULT_FOR, which every scenario may use without naming them."""


@cache
def plugins() -> tuple[ModuleType, ...]:
    """Return the modules that installed packages register in the entry-point group weldcal.drivers.

    Raises:
        InputError: one of them cannot be imported; the message names its package.
    """
    found = []
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda p: p.name):
        try:
            loaded = point.load()
        except Exception as error:  # a third-party module may raise anything while it is imported
            package = "an installed package" if point.dist is None else f"the package {point.dist.name}"
            raise InputError(
                f"The driver '{point.name}' of {package} cannot be imported: {error}. Update or uninstall that package."
            ) from error
        found.append(loaded if isinstance(loaded, ModuleType) else inspect.getmodule(loaded))
    return tuple(module for module in found if module is not None)


@cache
def driver_configs(device: str, tags: frozenset[str] | None = None) -> tuple[type[DriverConfig], ...]:
    """Return the configuration classes of the drivers of a device, its default first.

    Args:
        device: one of DEVICES.
        tags: the own drivers that are wanted besides the defaults, which saves the import of the others; None: all.

    Raises:
        InputError: two drivers have the same name.
    """
    found: dict[str, type[DriverConfig]] = {NoDevice.__name__: NoDevice}
    for module in (*_own_modules(tags), *plugins()):
        for config in _configs_of(module):
            if device not in config.FOR:
                continue
            if found.setdefault(config.__name__, config) is not config:
                raise InputError(
                    f"Two drivers are called {config.__name__}, in {found[config.__name__].__module__} and in "
                    f"{config.__module__}: uninstall the package of one of them."
                )
    default = next((c for c in found.values() if device in c.DEFAULT_FOR), NoDevice)
    return (default, *sorted((c for c in found.values() if c is not default), key=lambda c: c.__name__))


def default_config(device: str) -> DriverConfig:
    """Return the default configuration of a device, used where a scenario does not name it."""
    return driver_configs(device, frozenset())[0]()


def _own_modules(tags: frozenset[str] | None) -> tuple[ModuleType, ...]:
    """Return the modules of own drivers, in the order of their names."""
    wanted = sorted({module for tag, module in OWN.items() if tags is None or tag in tags | DEFAULTS})
    return tuple(importlib.import_module(f"weldcal.systems.drivers.{module}") for module in wanted)


def _configs_of(module: ModuleType) -> list[type[DriverConfig]]:
    """Return the configuration classes that a module itself defines, with their field types resolved to objects."""
    found: list[type[DriverConfig]] = []
    for member in vars(module).values():
        if not (inspect.isclass(member) and issubclass(member, DriverConfig) and member.__module__ == module.__name__):
            continue
        if member.FOR and hasattr(member, "__dataclass_fields__"):
            if inspect.isabstract(member):
                missing = ", ".join(sorted(f"{name}()" for name in vars(member)["__abstractmethods__"]))
                raise InputError(
                    f"The driver {member.__name__} in {module.__name__} does not define {missing}: add it there."
                )
            _resolve_types(member)
            found.append(member)
    return found


def _resolve_types(config: type[DriverConfig]) -> None:
    """Replace field types that are text (postponed annotations) by the types, which Drake's YAML loader needs."""
    types = get_type_hints(config)
    for field in config.__dataclass_fields__.values():  # type: ignore[attr-defined]
        if isinstance(field.type, str):
            field.type = types[field.name]
