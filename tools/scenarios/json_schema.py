"""Writes the JSON schema of a scenario, by which editors complete and check its keys."""

from functools import cache
from types import NoneType, UnionType
from typing import Any, get_args, get_origin

from weldcal.systems.drivers.config import DEVICES
from weldcal.systems.scenario.loading import scenario_class
from weldcal.systems.scenario.schema import Scenario
from weldcal.tools.scenarios.fields import Key, keys_of

DIALECT = "https://json-schema.org/draft/2020-12/schema"
_PLAIN = {float: "number", int: "integer", bool: "boolean", str: "string"}


@cache
def json_schema() -> dict[str, Any]:
    """The schema; drivers are told apart by their keys, because a JSON schema does not see a YAML tag."""
    meanings = {key.name: key.meaning for key in keys_of(Scenario)}
    return {"$schema": DIALECT, "title": "weldcal scenario", **_object(scenario_class(), meanings)}


def _object(config: type, meanings: dict[str, str] | None = None) -> dict[str, Any]:
    properties = {key.name: _property(key, (meanings or {}).get(key.name, "")) for key in keys_of(config)}
    return {"type": "object", "additionalProperties": False, "properties": properties}


def _property(key: Key, meaning: str) -> dict[str, Any]:
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
