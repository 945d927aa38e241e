"""Writes a commented scenario of one's own, with every key that a shipped scenario uses and every other one as a comment."""

import dataclasses as dc
import json
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from weldcal.models.errors import InputError
from weldcal.models.result_files import write_atomic
from weldcal.systems.drivers.config import DEVICES, NoDevice
from weldcal.systems.scenario.loading import load_scenario
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.scenarios.fields import Key, keys_of
from weldcal.tools.scenarios.json_schema import json_schema
from weldcal.tools.scenarios.own_part import add_part, add_tool, weldable_place
from weldcal.tools.scenarios.values import yaml_of

CELL, SCHEMA = "cell.yaml", "cell.schema.json"
WIDTH = 120
LEFT_OUT = ("extends", "visualization")
HEAD = """# yaml-language-server: $schema={schema}
# A cell of your own. It runs as it is, in simulation:
#   weldcal demo --scenario {path}
# A key behind a `#` has its default: remove the `#` to change it. Positions are in the robot's base, in metres; `rpy_deg` are roll,
# pitch and yaw about fixed axes. All keys: docs/scenario.md. With real devices: docs/your_cell.md, and
#   weldcal check-cell {path}
"""


@dataclass(frozen=True)
class OwnPart:
    """A part's file, the numbers of the seam's edges (none: the longest concave one), and the joint (None: by its angle)."""

    file: Path
    edges: tuple[int, ...] = ()
    joint: str | None = None


def write_cell(folder: Path, base: str, part: OwnPart | None = None, tool: Path | None = None) -> Path:
    """Write cell.yaml and its JSON schema into a folder, with a part and a tool of one's own, and return the path of cell.yaml.

    Raises:
        InputError: there is one already, `base` is no scenario, or the part cannot be used.
    """
    scenario = load_scenario(base)
    path = folder / CELL
    if path.exists():
        raise InputError(f"There is a cell in '{folder}' already: choose another folder, or delete {CELL}.")
    folder.mkdir(parents=True, exist_ok=True)
    if part is not None:
        scenario.description = f"A cell that welds {part.file.name}."
        add_part(scenario, folder, part.file, list(part.edges), part.joint)
    if tool is not None:
        add_tool(scenario, folder, tool)
    write_atomic(folder / SCHEMA, json.dumps(json_schema(), indent=1) + "\n")
    _write(path, scenario)
    if part is not None and scenario.workpiece is not None and (place := weldable_place(load_scenario(str(path)))):
        scenario.workpiece.pose_guess = place
        _write(path, scenario)
    return path


def _write(path: Path, scenario: Scenario) -> None:
    write_atomic(path, HEAD.format(schema=SCHEMA, path=path) + "".join(_parts(scenario)))


def _parts(scenario: Scenario) -> Iterator[str]:
    meanings = {key.name: key.meaning for key in keys_of(Scenario)}
    for key in keys_of(type(scenario)):
        value = getattr(scenario, key.name)
        absent = isinstance(value, NoDevice) and isinstance(key.default, NoDevice)
        if key.name in LEFT_OUT or (value is None and key.parts) or absent:
            continue
        meaning = meanings.get(key.name) or key.meaning
        if not dc.is_dataclass(value):
            yield _line(dc.replace(key, meaning=meaning), value, "")
            continue
        tag = f" !{type(value).__name__}" if key.name in DEVICES else ""
        comment = f"# {meaning}\n" if meaning else ""
        below = "".join(_below(value, "  "))
        yield f"\n{comment}{key.name}:{tag}" + (f"\n{below}" if below else " {}\n")


def _below(config: Any, indent: str) -> Iterator[str]:
    keys = keys_of(type(config))
    changed = any(getattr(config, key.name) != key.default for key in keys)
    for k, key in enumerate(keys):
        # a mapping needs one key
        yield _line(key, getattr(config, key.name), indent, written=k == 0 and not changed)


def _line(key: Key, value: Any, indent: str, written: bool = False) -> str:
    """The key with its value, behind a comment sign where that is the default, and what it means."""
    meaning = key.meaning
    mark = "# " if value == key.default and not written and key.name != "description" else ""
    text = f"{indent}{mark}{key.name}: {yaml_of(value)}"
    if not meaning:
        return text + "\n"
    if len(text) + 4 + len(meaning) <= WIDTH:
        return f"{text}  # {meaning}\n"
    above = textwrap.wrap(meaning, WIDTH - len(indent) - 2)
    return "".join(f"{indent}# {words}\n" for words in above) + text + "\n"
