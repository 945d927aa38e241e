"""Writes values of a scenario as YAML on one line, and its types in words."""

import dataclasses as dc
import json
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

from weldcal.tools.scenarios.fields import Key, keys_of

_WORDS = {float: "number", int: "whole number", bool: "true or false", str: "text"}


def yaml_of(value: Any) -> str:
    """A plain value, list or dataclass as YAML on one line; of a dataclass only what is not its default."""
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


def changed_keys(config: Any) -> list[tuple[Key, Any]]:
    """The keys of a configuration that do not have their default, each with its value."""
    pairs = ((key, getattr(config, key.name)) for key in keys_of(type(config)))
    return [(key, value) for key, value in pairs if value != key.default]


def kind_in_words(kind: Any) -> str:
    """A type as a reader of the reference needs it."""
    if isinstance(kind, UnionType):
        kinds = [k for k in get_args(kind) if k is not NoneType]
        return " or ".join(dict.fromkeys(kind_in_words(k) for k in kinds))
    if get_origin(kind) is list:
        return f"list of {kind_in_words(get_args(kind)[0])}s"
    return _WORDS.get(kind, "keys below" if dc.is_dataclass(kind) else getattr(kind, "__name__", str(kind)))
