"""Packs a scenario with the files that it names, for a recording, and unpacks it again."""

from __future__ import annotations

import dataclasses as dc
import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Final

from weldcal.models.errors import InputError
from weldcal.models.scanners import is_scanner_file
from weldcal.models.workpieces.step import referenced
from weldcal.systems.scenario.loading import load_scenario, scenario_text
from weldcal.systems.scenario.schema import Scenario

SCENARIO: Final = "scenario.yaml"


def packed(scenario: Scenario) -> dict[str, bytes]:
    """The files of a recording by name: the scenario, and each file that it names beside it."""
    copy, files = deepcopy(scenario), dict[str, bytes]()
    for config, field in _files(copy):
        path = Path(getattr(config, field))
        name = path.name
        while name in files:
            name = f"{Path(name).stem}_{path.suffix}"
        files[name] = path.read_bytes()
        files |= {other.name: other.read_bytes() for other in referenced(path)}
        setattr(config, field, name)
    return {SCENARIO: scenario_text(copy).encode(), **files}


def unpacked(files: Mapping[str, bytes], folder: Path) -> Scenario:
    """Write the files of a recording into a folder and load the scenario.

    Raises:
        InputError: the recording holds no scenario, or one that this version cannot load.
    """
    if SCENARIO not in files:
        raise InputError("The recording was cut off before its scenario: record the run again.")
    for name, data in files.items():
        if Path(name).name != name:
            raise InputError(f"The recording names a file outside of its folder ('{name}'): do not use it.")
        (folder / name).write_bytes(data)
    scenario = load_scenario(str(folder / SCENARIO))
    if not re.search(rb"^  arc:", files[SCENARIO], re.MULTILINE):
        scenario.welding.arc.start = "moving"  # as before that key, for `packed` writes every key
    return scenario


def _files(config: Any) -> Iterator[tuple[Any, str]]:
    """The configurations in a tree with the names of their fields that name a file that exists."""
    for field in dc.fields(config):
        value = getattr(config, field.name)
        for item in value if isinstance(value, list) else [value]:
            if dc.is_dataclass(item):
                yield from _files(item)
        named = field.metadata.get("file") or (field.name.endswith("preset") and is_scanner_file(str(value)))
        if named and value and Path(value).is_file():
            yield config, field.name
