"""Loads scenarios, by name from the package or by path; unknown keys are errors."""

import dataclasses as dc
import re
from functools import cache, partial, reduce
from operator import or_
from pathlib import Path
from typing import Any

from pydrake.common.yaml import yaml_load_typed

from weldcal.models.documents import parse_document
from weldcal.models.errors import InputError
from weldcal.models.files import read_text
from weldcal.models.limits import LARGEST_DOCUMENT
from weldcal.models.scanners import get_scanner, is_scanner_file
from weldcal.systems.drivers.config import DEVICES
from weldcal.systems.drivers.discovery import default_config, driver_configs
from weldcal.systems.jobs.discovery import jobs
from weldcal.systems.scenario.checks import check_scenario
from weldcal.systems.scenario.schema import Scenario, ToolFile
from weldcal.systems.scenario.workpiece import resolved

LARGEST_WIDTH = 4096
SCENARIO_FOLDER = Path(__file__).resolve().parents[2] / "models" / "scenarios"


def scenario_names() -> list[str]:
    """Names of the scenarios in the package."""
    return sorted(path.stem for path in SCENARIO_FOLDER.glob("*.yaml"))


@cache
def scenario_class() -> type[Scenario]:
    """The schema with a union of all installed drivers for each device, and an optional key for each job.

    Raises:
        InputError: an installed driver cannot be used.
    """
    fields: list[tuple[str, Any, Any]] = []
    for device in DEVICES:
        union = reduce(or_, driver_configs(device))
        fields.append((device, union, dc.field(default_factory=partial(default_config, device))))
    fields += [(job.key, job.config | None, None) for job in jobs() if job.key and job.config is not None]
    return dc.make_dataclass("Scenario", fields, bases=(Scenario,))


def load_scenario(name: str, overrides: str = "") -> Scenario:
    """Load a scenario by name or path; `overrides` is a second YAML text merged over it.

    Raises:
        InputError: unknown name, unknown key, wrong type; the message says which.
    """
    path = Path(name) if name.endswith((".yaml", ".yml")) else SCENARIO_FOLDER / f"{name}.yaml"
    if not path.exists():
        raise InputError(
            f"There is no scenario '{name}': choose one of {', '.join(scenario_names())} or give a YAML file."
        )
    schema = scenario_class()
    scenario = schema()
    for label, text in ((str(path.name), read_text(path, LARGEST_DOCUMENT)), ("the overrides", overrides)):
        if not text.strip():
            continue
        parse_document(label, text)  # within bounds, no key twice
        try:
            scenario = yaml_load_typed(schema=schema, data=text, defaults=scenario)
        except Exception as error:  # Drake's loader raises several types, and not every message names the key
            what = " ".join(str(error).split())
            raise InputError(f"Scenario {label} cannot be read{_part_at_fault(text)}: {what}") from error
    _find_scanner_file(scenario, path.resolve().parent)
    if isinstance(scenario.tool, ToolFile):
        scenario.tool.file = str(path.resolve().parent / scenario.tool.file)
        _use_camera_of(scenario)
    if scenario.workpiece is not None:
        scenario.workpiece = resolved(scenario.workpiece, path.resolve().parent)
    check_scenario(scenario)
    return scenario


def _find_scanner_file(scenario: Scenario, folder: Path) -> None:
    """Make the path of a scanner file absolute, and its image as wide as a preset's by default, in the file's shape."""
    config = scenario.scanner
    own = vars(config)
    for key in [key for key in own if key.endswith("preset") and isinstance(own[key], str)]:
        if not is_scanner_file(own[key]):
            continue
        own[key] = str(folder / own[key])
        default = vars(type(config)())
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


def _part_at_fault(text: str) -> str:
    """The top-level part of a YAML text that does not load by itself, as a phrase for a message; empty where not found."""
    schema = scenario_class()
    parts = re.split(r"^(?=\w+ *:)", text, flags=re.MULTILINE)
    for part in filter(str.strip, parts):
        try:
            yaml_load_typed(schema=schema, data=part, defaults=schema())
        except Exception:  # the same loader as above: any failure identifies this part
            return f" at '{part.split(':')[0].strip()}'"
    return ""
