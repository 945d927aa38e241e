"""Loads scenarios, by name from the package or by path; unknown keys are errors."""

import dataclasses as dc
import re
from collections.abc import Iterable, Iterator
from datetime import date
from functools import cache, partial, reduce
from operator import or_
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

from pydrake.common.yaml import yaml_dump_typed, yaml_load, yaml_load_typed

from weldcal.models.documents import did_you_mean, nearest, parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import LARGEST_DOCUMENT, read_text
from weldcal.models.scanners import get_scanner, is_scanner_file
from weldcal.systems.drivers.config import DEVICES, NoDevice
from weldcal.systems.drivers.discovery import OWN, default_config, driver_configs
from weldcal.systems.jobs.job import job_at, job_keys
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.schema import PoseConfig, Scenario

REMOVED = {
    "welding.law": "the guarded law is the only one",
    **dict.fromkeys(
        ("calibration.cost", "calibration.work_radius_mm", "calibration.cost_axes"),
        "weldcal calibrate --compare runs Algorithm 1 on recorded scans",
    ),
}
"""Keys of earlier versions, and what there is in their place."""


def check_keys(schema: type, document: Any, place: str = "") -> None:
    """Check the keys of a parsed YAML document against a dataclass, in all its parts.

    Raises:
        InputError: the first unknown key or driver, with the nearest known one.
    """
    if not isinstance(document, dict):
        return
    known = {field.name: field.type for field in dc.fields(schema)}
    for key, value in document.items():
        if key == "_tag":
            continue
        if why := REMOVED.get(f"{place}{key}"):
            raise InputError(f"The key {place}{key} was removed: leave it out ({why}).")
        if key not in known:
            where = f" in {place.rstrip('.')}" if place else ""
            raise InputError(f"The key '{key}'{where} is not known{_suggestion(str(key), known)}.")
        _check_value(known[key], value, f"{place}{key}")


def _check_value(kind: Any, value: Any, place: str) -> None:
    if get_origin(kind) is list and isinstance(value, list):
        for k, item in enumerate(value):
            _check_value(get_args(kind)[0], item, f"{place}[{k}]")
        return
    if kind is str and isinstance(value, int | float | date):
        raise InputError(f"the value at '{place}' is a text: write '{value}' in quotes.")
    kinds = get_args(kind) if isinstance(kind, UnionType) else (kind,)
    if isinstance(value, int | float | str) and {get_origin(k) or k for k in kinds} <= {list, NoneType}:
        raise InputError(f"the value at '{place}' is a list: write [{value}, ...].")
    choices = {c.__name__: c for c in kinds if isinstance(c, type) and dc.is_dataclass(c)}
    if not choices or not isinstance(value, dict):
        return
    tag = str(value.get("_tag", "")).lstrip("!")
    if tag and tag not in choices:
        raise InputError(f"{place}: there is no driver '!{tag}'{_suggestion(tag, choices, '!')}.")
    check_keys(choices[tag] if tag else next(iter(choices.values())), value, f"{place}.")


def _suggestion(word: str, known: Any, mark: str = "") -> str:
    near = nearest(word, known)
    if near is not None:
        return f"; the nearest one is '{mark}{near}'"
    listed = ", ".join(f"{mark}{name}" for name in known)
    return f"; known are {listed}"


LARGEST_WIDTH = 4096
SCENARIO_FOLDER = Path(__file__).resolve().parents[2] / "models" / "scenarios"


def scenario_names() -> list[str]:
    """Names of the scenarios in the package."""
    return sorted(path.stem for path in SCENARIO_FOLDER.glob("*.yaml"))


@cache
def scenario_class(keys: frozenset[str] | None = None, tags: frozenset[str] | None = None) -> type[Scenario]:
    """The schema with a union of the installed drivers for each device, and an optional key for each job.

    Args:
        keys: the jobs that are wanted; the others' keys hold None only, and their modules are not imported. None: all.
        tags: see driver_configs.

    Raises:
        InputError: an installed driver cannot be used.
    """
    fields: list[tuple[str, Any, Any]] = []
    for device in DEVICES:
        union = reduce(or_, driver_configs(device, tags))
        fields.append((device, union, dc.field(default_factory=partial(default_config, device))))
    for key in job_keys():
        config = str if keys is not None and key not in keys else job_at(key).config
        if config is not None:
            fields.append((key, config | None, None))
    return dc.make_dataclass("Scenario", fields, bases=(Scenario,))


def _class_with(keys: Iterable[str], tags: Iterable[str]) -> type[Scenario]:
    """The schema with these jobs and drivers; with all drivers where one is of another package, or unknown."""
    named = frozenset(tags) - {NoDevice.__name__}
    return scenario_class(frozenset(keys) & {*job_keys()}, named if named <= OWN.keys() else None)


def scenario_text(scenario: Scenario) -> str:
    """Return the YAML text of a scenario, which may have another driver than the file that it was loaded from.

    Raises:
        RuntimeError: a driver was made in Python, and no file can name it.
    """
    keys = [key for key in job_keys() if getattr(scenario, key, None) is not None]
    schema = _class_with(keys, [type(getattr(scenario, device)).__name__ for device in DEVICES])
    return str(yaml_dump_typed(scenario, schema=schema))


def use_nominal_scanner(scenario: Scenario) -> None:
    """Put a simulated scanner exactly at its nominal pose, and state this pose as the known one."""
    scanner = scenario.scanner_config()
    if scanner is not None and scanner.mounted_on in ("base", "flange") and (pose := scanner.put_at_nominal()):
        setattr(scenario.job, "X_FC" if scanner.mounted_on == "flange" else "X_BC", PoseConfig(*pose))


def load_scenario(name: str, overrides: str = "") -> Scenario:
    """Load a scenario by name or path; `overrides` is a second YAML text merged over it.

    A weld without a calibration and without a known pose takes the nominal pose of a simulated scanner.

    Raises:
        InputError: unknown name, unknown key, wrong type; the message says which.
    """
    parts = [*_chain(name, ())]
    if overrides.strip():
        parts.append(("the overrides", overrides, _path_of(name).parent))
    keys = (parse_document(label, text) for label, text, _ in parts if text.strip())
    named = {str(key) for document in keys if isinstance(document, dict) for key in document}
    scenario = _class_with(named, (tag for _, text, _ in parts for tag in re.findall(r"!(\w+)", text)))()
    for label, text, folder in parts:
        scenario = _merged(scenario, label, text)
        resolve_files(scenario, folder)
    _use_width_of_scanner_file(scenario)
    _use_camera_of(scenario)
    if (job := scenario.job).weld and not (job.calibrate or job.X_BC or job.X_FC):
        use_nominal_scanner(scenario)
    check_scenario(scenario)
    return scenario


def _path_of(name: str) -> Path:
    return Path(name) if name.endswith((".yaml", ".yml")) else SCENARIO_FOLDER / f"{name}.yaml"


def _chain(name: str, before: tuple[Path, ...]) -> Iterator[tuple[str, str, Path]]:
    """Names, texts and folders of a scenario's files, each after the one that it extends; `before` have led here."""
    path = _path_of(name)
    if not path.exists():
        asked = (
            f"{before[-1].name} extends '{name}', which does not exist" if before else f"There is no scenario '{name}'"
        )
        listed = f"choose one of {', '.join(scenario_names())} or give a YAML file."
        near = [str(p) for p in sorted(path.parent.glob("*.yaml"))] if path.parent.is_dir() else []
        raise InputError(f"{asked}: {did_you_mean(name, [*near, *scenario_names()], listed)}")
    if path.resolve() in before:
        raise InputError(f"{before[0].name} extends itself through {path.name}: remove one `extends`.")
    text = read_text(path, LARGEST_DOCUMENT)
    document = parse_document(path.name, text) if text.strip() else None  # within bounds, no key twice
    base = document.get("extends") if isinstance(document, dict) else None
    if base:
        beside = path.parent / str(base)
        yield from _chain(str(beside) if beside.suffix and beside.exists() else str(base), (*before, path.resolve()))
    yield path.name, text, path.parent


def _merged(scenario: Scenario, label: str, text: str) -> Scenario:
    """A scenario with the keys of a YAML text in place of its own."""
    if not text.strip():
        return scenario
    schema = type(scenario)
    try:
        document = yaml_load(data=text)
        try:
            check_keys(schema, document)
        except InputError:
            check_keys(scenario_class(), document)  # whose message lists every key and driver
            raise
        merged: Scenario = yaml_load_typed(schema=schema, data=text, defaults=scenario)
    except InputError as error:
        raise InputError(f"Scenario {label}: {str(error)[0].lower()}{str(error)[1:]}") from error
    except Exception as error:  # Drake's loader raises several types, and not every message names the key
        what = " ".join(str(error).split())
        raise InputError(f"Scenario {label} cannot be read{_part_at_fault(schema, text)}: {what}") from error
    return merged


def resolve_files(config: Any, folder: Path) -> None:
    """Replace each relative path in a tree of configurations by the file beside the scenario, where there is one."""
    for field in dc.fields(config):
        value = getattr(config, field.name)
        for item in value if isinstance(value, list) else [value]:
            if dc.is_dataclass(item):
                resolve_files(item, folder)
        named = field.metadata.get("file") or (field.name.endswith("preset") and is_scanner_file(str(value)))
        if named and value and not isinstance(value, str | Path):
            raise InputError(f"The scenario's key {field.name} names a file, not {str(value)[:20]}; give its path.")
        if named and value and not Path(value).is_absolute() and (folder / value).exists():
            setattr(config, field.name, str(folder / value))


def _use_width_of_scanner_file(scenario: Scenario) -> None:
    """Make the image of a scanner from a file as wide as a preset's by default, in the file's shape."""
    own = vars(scenario.scanner)
    for key in [key for key in own if key.endswith("preset") and is_scanner_file(str(own[key]))]:
        default = vars(type(scenario.scanner)())
        if "width" in own and (own["width"], own["height"]) == (default["width"], default["height"]):
            narrow = min(default["width"] or LARGEST_WIDTH, get_scanner(own[key]).width)
            own["width"], own["height"] = narrow, None


def _use_camera_of(scenario: Scenario) -> None:
    """Give the finger camera what the tool's file says of it, where the scenario does not say otherwise."""
    loaded, camera = scenario.loaded_tool(), scenario.finger_camera
    if loaded is None:
        return
    for key in ("width", "height", "focal_px"):
        if hasattr(camera, key) and getattr(camera, key) == getattr(type(camera)(), key):
            setattr(camera, key, getattr(loaded.camera, key))
    own = vars(camera)
    if loaded.calibration and "calibration" in own and not own["calibration"]:
        own["calibration"] = loaded.calibration


def _part_at_fault(schema: type[Scenario], text: str) -> str:
    """The top-level part of a YAML text that does not load by itself, as a phrase for a message.

    Empty where not found.
    """
    parts = re.split(r"^(?=\w+ *:)", text, flags=re.MULTILINE)
    for part in filter(str.strip, parts):
        try:
            yaml_load_typed(schema=schema, data=part, defaults=schema())
        except Exception:  # the same loader as above: any failure identifies this part
            return f" at '{part.split(':')[0].strip()}'"
    return ""
