"""URScript's operators on values: numbers, lists, matrices and structs, as the compiled program calls them."""

import math
import operator
from collections.abc import Callable
from typing import Any

from weldcal.tools.emulators.ur.script.syntax import ScriptError

NUMBERS = (int, float)  # the exact types: True is no number


class Pose(list[float]):
    """p[x, y, z, rx, ry, rz]: metres and a rotation vector in radians."""


class Struct(dict[str, Any]):
    """struct(name=value, ...): its members are fixed when it is made."""


def copied(value: Any) -> Any:
    """A list or struct of its own, since assignment copies; anything else as it is."""
    if value is None:
        raise ScriptError("A function that returns nothing is used as a value.")
    return type(value)(value) if isinstance(value, list | Struct) else value


def item(values: Any, index: Any) -> Any:
    """values[index], or the member of a struct."""
    if type(values) is list and type(index) is int and 0 <= index < len(values):
        return values[index]
    if isinstance(values, Struct):
        if index not in values:
            raise ScriptError(f"The struct has no member {index!r}.")
        return values[index]
    if not isinstance(values, list) or isinstance(index, bool) or not isinstance(index, int):
        raise ScriptError("Only a list or a pose has an index, and the index is a whole number.")
    if not 0 <= index < len(values):
        raise ScriptError(f"Index {index} is outside of a list of {len(values)}.")
    return values[index]


def place(values: Any, index: Any, value: Any) -> None:
    """values[index] = value."""
    item(values, index)
    values[index] = value


def truth(value: Any) -> bool:
    """A condition: True, False, or a number that is not 0 (UR's own control script asks so for a seed)."""
    if value is True or value is False:
        return value
    if type(value) in NUMBERS:
        return bool(value != 0)
    raise ScriptError(f"A condition must be True or False, it is {value!r}.")


def number(value: Any) -> Any:
    """The value, where it is a number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScriptError(f"Arithmetic needs a number, it got {value!r}.")
    return value


def added(left: Any, right: Any) -> Any:
    """left + right."""
    if type(left) in NUMBERS and type(right) in NUMBERS:
        return left + right
    return _each(operator.add, left, right)


def subtracted(left: Any, right: Any) -> Any:
    """left - right."""
    if type(left) in NUMBERS and type(right) in NUMBERS:
        return left - right
    return _each(operator.sub, left, right)


def multiplied(left: Any, right: Any) -> Any:
    """left * right: element by element, or the matrix product where the left side is a matrix and the right a list."""
    if type(left) in NUMBERS and type(right) in NUMBERS:
        return left * right
    if _is_matrix(left) and isinstance(right, list):
        columns = list(zip(*right, strict=True)) if _is_matrix(right) else [right]
        product = [[_inner(row, column) for column in columns] for row in left]
        return product if _is_matrix(right) else [row[0] for row in product]
    return _each(operator.mul, left, right)


def divided(left: Any, right: Any) -> Any:
    """left / right."""
    return _each(_quotient, left, right)


def remainder(left: Any, right: Any) -> Any:
    """left % right, with the sign of the left side; of whole numbers a whole number."""
    return _each(_remainder, left, right)


def negated(value: Any) -> Any:
    """-value."""
    return [negated(part) for part in value] if _is_plain(value) else -number(value)


def method(target: Any, name: str, *arguments: Any) -> Any:
    """target.name(...): what a list of variable length can do."""
    if not isinstance(target, list) or isinstance(target, Pose):
        raise ScriptError(f"Only a list has {name}().")
    if name == "append":
        target.append(*arguments)
    elif name == "remove":
        del target[arguments[0]]
    elif name == "clear":
        target.clear()
    elif name == "length":
        return len(target)
    else:
        raise ScriptError(f"A list has no {name}().")
    return target


def _each(apply: Callable[[Any, Any], Any], left: Any, right: Any) -> Any:
    if _is_plain(left):
        if not _is_plain(right):
            return [_each(apply, part, right) for part in left]
        if len(left) != len(right):
            raise ScriptError(f"Lists of {len(left)} and {len(right)} have no sum, difference, product or quotient.")
        return [_each(apply, a, b) for a, b in zip(left, right, strict=True)]
    if _is_plain(right):
        return [_each(apply, left, part) for part in right]
    return apply(number(left), number(right))


def _is_plain(value: Any) -> bool:
    return isinstance(value, list) and not isinstance(value, Pose)


def _is_matrix(value: Any) -> bool:
    return _is_plain(value) and bool(value) and all(_is_plain(row) for row in value)


def _inner(row: list[Any], column: Any) -> Any:
    if len(row) != len(column):
        raise ScriptError(f"A matrix with {len(row)} columns cannot multiply {len(column)} rows.")
    return sum(number(a) * number(b) for a, b in zip(row, column, strict=True))


def _quotient(left: Any, right: Any) -> Any:
    if right == 0:
        raise ScriptError("Division by zero.")
    return left / right


def _remainder(left: Any, right: Any) -> Any:
    if right == 0:
        raise ScriptError("Division by zero.")
    found = math.fmod(left, right)
    return int(found) if isinstance(left, int) and isinstance(right, int) else found
