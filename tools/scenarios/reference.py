"""Writes the reference of all keys of a scenario as a Markdown page, from the configuration classes themselves."""

import inspect
from collections.abc import Iterator

from weldcal.systems.drivers.config import DEVICES, NoDevice
from weldcal.systems.scenario.loading import scenario_class
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.scenarios.fields import Key, keys_of
from weldcal.tools.scenarios.values import kind_in_words, yaml_of

HEAD = """# Keys of a scenario

Written by `weldcal schema --markdown`; do not edit. How to write a scenario: [scenarios.md](scenarios.md). Installed packages may add
drivers. A key that is left out has its default. Units are in the names: m, mm, deg, s. Poses are in the robot's base.
"""


def reference() -> str:
    """The page."""
    return HEAD + "".join(_sections())


def _sections() -> Iterator[str]:
    top = keys_of(scenario_class())
    # the base class's source has the comments; the class that is made of the installed drivers has the types
    meanings = {key.name: key.meaning for key in keys_of(Scenario)}
    yield "\n## Top level\n\n" + _table([key for key in top if not key.parts], meanings)
    for key in top:
        if key.name in DEVICES:
            yield _device(key)
        elif key.parts:
            yield from _part(key.name, key.parts[0], "##", key.listed)


def _part(name: str, config: type, mark: str, listed: bool = False) -> Iterator[str]:
    keys = keys_of(config)
    many = " (a list)" if listed else ""
    yield f"\n{mark} `{name}`{many}\n\n{_sentence(config)}\n\n{_table(keys, {})}"
    for key in keys:
        if len(key.parts) == 1 and key.parts[0].__name__ != "PoseConfig":
            yield from _part(f"{name}.{key.name}", key.parts[0], "###", key.listed)


def _device(key: Key) -> str:
    drivers = [part for part in key.parts if part is not NoDevice]
    used = type(key.default).__name__
    text = (
        f"\n## `{key.name}`\n\nDrivers: {', '.join(f'`!{d.__name__}`' for d in drivers)}. Left out: `!{used} {{}}`.\n"
    )
    for driver in drivers:
        if key.name == "robot_2":
            continue  # as those of robot
        text += f"\n### `{key.name}: !{driver.__name__}`\n\n{_sentence(driver)}\n\n{_table(keys_of(driver), {})}"
        text += "".join(_parts_of(driver, key.name))
    return text


def _parts_of(driver: type, device: str) -> Iterator[str]:
    """The keys of the parts that a driver's keys hold, each kind of part once."""
    named: dict[type, list[str]] = {}
    for key in keys_of(driver):
        for part in key.parts:
            if part.__name__ != "PoseConfig":
                named.setdefault(part, []).append(f"`{device}.{key.name}`")
    for part, names in named.items():
        yield f"\n#### {', '.join(names)}\n\n{_sentence(part)}\n\n{_table(keys_of(part), {})}"


def _sentence(config: type) -> str:
    first = (inspect.getdoc(config) or "").split("\n\n")[0]
    return " ".join(first.split())


def _table(keys: tuple[Key, ...] | list[Key], meanings: dict[str, str]) -> str:
    if not keys:
        return "No keys.\n"
    rows = [
        f"| `{key.name}` | {_kind(key)} | {_default(key)} | {_cell(meanings.get(key.name) or key.meaning)} |"
        for key in keys
    ]
    return "\n".join(["| key | value | default | meaning |", "|---|---|---|---|", *rows]) + "\n"


def _kind(key: Key) -> str:
    if len(key.parts) == 1 and key.parts[0].__name__ == "PoseConfig":
        return "pose: `xyz_m`, `rpy_deg`"
    return kind_in_words(key.kind)


def _default(key: Key) -> str:
    return "" if key.parts and key.default is not None else f"`{yaml_of(key.default)}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
