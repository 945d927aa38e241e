"""weldcal schema: a scenario's keys as the JSON schema for editors, or as the reference page."""

import ast
import dataclasses as dc
import inspect
import io
import json
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin

import typer

from weldcal.systems.drivers.config import DEVICES, NoDevice
from weldcal.systems.scenario.loading import scenario_class
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.cli.options import LOOK, Call, Outcome, command, switch

_WORDS = {float: "number", int: "whole number", bool: "true or false", str: "text"}
DIALECT = "https://json-schema.org/draft/2020-12/schema"
_PLAIN = {float: "number", int: "integer", bool: "boolean", str: "string"}
HEAD = """# Keys of a scenario

Written by `weldcal schema --markdown`; do not edit. How to write a scenario: [scenarios.md](scenarios.md).
Installed packages may add drivers. A key that is left out has its default. Units are in the names: m, mm, deg, s. Poses
are in the robot's base.
"""


@command("schema", common=LOOK, short_help="Print the keys that a scenario may have.")
def schema(
    call: Call,
    markdown: Annotated[bool, switch("--markdown", "Print the reference page instead of the JSON schema.")] = False,
) -> Outcome:
    """Print the JSON schema of a scenario, for editors, with the drivers that are installed."""
    text = reference() if markdown else json.dumps(json_schema(), indent=1) + "\n"
    return Outcome(json_schema(), text=partial(typer.echo, text, nl=False))


@dataclass(frozen=True)
class SchemaKey:
    """One key: its name, its type, its default value, and what it means."""

    name: str
    kind: Any
    default: Any
    meaning: str

    @property
    def parts(self) -> tuple[type, ...]:
        """The dataclasses that its value may be; empty where it is a plain value."""
        kinds = get_args(self.kind) if isinstance(self.kind, UnionType) else (self.kind,)
        inner = (get_args(k)[0] if get_origin(k) is list else k for k in kinds)
        return tuple(k for k in inner if isinstance(k, type) and dc.is_dataclass(k))

    @property
    def listed(self) -> bool:
        """Whether the value is a list."""
        return get_origin(self.kind) is list

    @property
    def optional(self) -> bool:
        """Whether null is a value."""
        return isinstance(self.kind, UnionType) and NoneType in get_args(self.kind)


def keys_of(config: type) -> tuple[SchemaKey, ...]:
    """Return the keys of a dataclass, those of its base classes included, in their order."""
    comments: dict[str, str] = {}
    for base in reversed(config.__mro__):
        if dc.is_dataclass(base) and "__dataclass_fields__" in vars(base):
            comments |= _comments(base)
    default = config() if not inspect.isabstract(config) else None
    return tuple(
        SchemaKey(field.name, field.type, getattr(default, field.name), comments.get(field.name, ""))
        for field in dc.fields(config)
    )


@cache
def _comments(config: type) -> dict[str, str]:
    """Comments of the fields that a class itself defines; empty for a class made at run time, which has no source."""
    try:
        source = textwrap.dedent(inspect.getsource(config))
    except (OSError, TypeError):
        return {}
    comments = {
        token.start[0]: (token.start[1], token.string.lstrip("# ").rstrip())
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    lines = source.splitlines()
    found = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        beside = [comments[n][1] for n in range(node.lineno, (node.end_lineno or node.lineno) + 1) if n in comments]
        above: list[str] = []
        n = node.lineno - 1
        while not beside and n in comments and lines[n - 1].lstrip().startswith("#"):
            above.insert(0, comments[n][1])
            n -= 1
        found[node.target.id] = " ".join(beside or above)
    return found


def yaml_of(value: Any) -> str:
    """Return a plain value, list or dataclass as YAML on one line; of a dataclass only what is not its default."""
    if dc.is_dataclass(value) and not isinstance(value, type):
        changed = (f"{key.name}: {yaml_of(given)}" for key, given in changed_keys(value))
        return f"{{{', '.join(changed)}}}"
    if isinstance(value, list):
        return f"[{', '.join(yaml_of(item) for item in value)}]"
    if isinstance(value, str):
        plain = value and value.replace("_", "").replace("-", "").replace(".", "").isalnum() and not value[0].isdigit()
        return (
            value if plain and value not in ("true", "false", "null", "yes", "no", "on", "off") else json.dumps(value)
        )
    return json.dumps(value)


def changed_keys(config: Any) -> list[tuple[SchemaKey, Any]]:
    """Return the keys of a configuration that do not have their default, each with its value."""
    pairs = ((key, getattr(config, key.name)) for key in keys_of(type(config)))
    return [(key, value) for key, value in pairs if value != key.default]


def kind_in_words(kind: Any) -> str:
    """Return a type as a reader of the reference needs it."""
    if isinstance(kind, UnionType):
        every = [k for k in get_args(kind) if k is not NoneType]
        kinds = [k for k in every if k is not int or float not in every]
        return " or ".join(dict.fromkeys(kind_in_words(k) for k in kinds))
    if get_origin(kind) is list:
        inner = kind_in_words(get_args(kind)[0])
        many = inner.replace("list", "lists", 1) if inner.startswith("list") else f"{inner}s"
        return f"list of {inner if inner == 'keys below' else many}"
    return _WORDS.get(kind, "keys below" if dc.is_dataclass(kind) else getattr(kind, "__name__", str(kind)))


@cache
def json_schema() -> dict[str, Any]:
    """Return the schema; drivers are recognised by their keys, because a JSON schema has no YAML tags."""
    meanings = {key.name: key.meaning for key in keys_of(Scenario)}
    return {"$schema": DIALECT, "title": "weldcal scenario", **_object(scenario_class(), meanings)}


def _object(config: type, meanings: dict[str, str] | None = None) -> dict[str, Any]:
    properties = {key.name: _property(key, (meanings or {}).get(key.name, "")) for key in keys_of(config)}
    return {"type": "object", "additionalProperties": False, "properties": properties}


def _property(key: SchemaKey, meaning: str) -> dict[str, Any]:
    schema = _value(key.kind)
    if key.name in DEVICES:
        schema = {"anyOf": [{"title": f"!{part.__name__}", **_object(part)} for part in key.parts]}
    words = meaning or key.meaning
    return {**schema, "description": words} if words else schema


def _value(kind: Any) -> dict[str, Any]:
    if isinstance(kind, UnionType):
        return {"anyOf": [_value(k) for k in get_args(kind)]}
    if kind is NoneType:
        return {"type": "null"}
    if get_origin(kind) is list:
        return {"type": "array", "items": _value(get_args(kind)[0])}
    if get_origin(kind) is dict:
        return {"type": "object", "additionalProperties": _value(get_args(kind)[1])}
    return {"type": _PLAIN[kind]} if kind in _PLAIN else _object(kind)


def reference() -> str:
    """Return the page."""
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


def _device(key: SchemaKey) -> str:
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


def _table(keys: tuple[SchemaKey, ...] | list[SchemaKey], meanings: dict[str, str]) -> str:
    if not keys:
        return "No keys.\n"
    rows = [
        f"| `{key.name}` | {_kind(key)} | {_default(key)} | {_cell(meanings.get(key.name) or key.meaning)} |"
        for key in keys
    ]
    return "\n".join(["| key | value | default | meaning |", "|---|---|---|---|", *rows]) + "\n"


def _kind(key: SchemaKey) -> str:
    if len(key.parts) == 1 and key.parts[0].__name__ == "PoseConfig":
        return "pose: `xyz_m`, `rpy_deg`"
    return kind_in_words(key.kind)


def _default(key: SchemaKey) -> str:
    return "" if key.parts and key.default is not None else f"`{yaml_of(key.default)}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
