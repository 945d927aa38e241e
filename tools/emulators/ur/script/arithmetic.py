"""URScript's values: operators as the compiled program calls them, and functions of strings and lists.

Values are bounded, since a program may not take the emulator's memory or time: see LARGEST, MOST_PARTS, DEEPEST and
EFFORT.
"""

import math
import operator
import re
from collections.abc import Callable
from typing import Any

from weldcal.tools.emulators.ur.script.syntax import ScriptError

NUMBERS = (int, float)  # the exact types: True is no number
LARGEST = 1 << 63  # [M] of whole numbers
MOST_PARTS = 100_000  # [M] elements of a value with all its lists, and characters of its texts
DEEPEST = 8  # [M] lists in lists
EFFORT = 400_000  # elements that the threads of a program may compute in one frame
LOOP_EFFORT = 100  # so much is one turn of a loop or one call: 4000 of them fit in a frame
_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


class Pose(list[float]):
    """p[x, y, z, rx, ry, rz]: metres and a rotation vector in radians."""


class Struct(dict[str, Any]):
    """struct(name=value, ...): its members are fixed when it is made."""


class Effort:
    """What the program that runs may still compute in this frame."""

    left = EFFORT

    @classmethod
    def spend(cls, parts: int) -> None:
        """Raises ScriptError where a frame is not enough."""
        cls.left -= parts
        if cls.left < 0:
            raise ScriptError(
                "Runtime is too much behind: a loop takes no time, or a calculation too much of it; add sync()."
            )


def copied(value: Any) -> Any:
    """Return a list or struct of its own, since assignment copies; anything else as it is."""
    if type(value) in NUMBERS:
        return value
    if value is None:
        raise ScriptError("A function that returns nothing is used as a value.")
    if not isinstance(value, list | Struct):
        return value
    Effort.spend(len(value))
    if isinstance(value, Struct):
        return Struct({name: copied(part) for name, part in value.items()})
    return type(value)(copied(part) if isinstance(part, list | Struct) else part for part in value)


def listed(*items: Any) -> list[Any]:
    """[a, b, ...] with lists of its own."""
    for item in items:
        if type(item) not in NUMBERS:
            return list(bounded([copied(item) for item in items]))
    return list(items)


def bounded(value: Any) -> Any:
    """Return the value, where it is not too large and not nested too deeply."""
    if isinstance(value, list | Struct | str) and (parts := _parts(value, 0)) > LOOP_EFFORT:
        Effort.spend(parts)
    return value


def _parts(value: Any, depth: int) -> int:
    if depth > DEEPEST:
        raise ScriptError("Lists are nested too deeply.")
    parts = len(value)
    if not isinstance(value, str):
        for part in value.values() if isinstance(value, Struct) else value:
            if isinstance(part, list | Struct | str):
                parts += _parts(part, depth + 1)
                if parts > MOST_PARTS:
                    break
    if parts > MOST_PARTS:
        raise ScriptError(f"A value has more than {MOST_PARTS} elements or characters.")
    return parts


def whole(value: Any) -> Any:
    """Return the number, where it is no whole number with too many digits."""
    if type(value) is int and not -LARGEST <= value < LARGEST:
        raise ScriptError("A whole number has more than 64 bits.")
    return value


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


def place(root: Any, indices: tuple[Any, ...], value: Any) -> None:
    """root[i][j] = value."""
    values = _at(root, indices[:-1])
    item(values, indices[-1])
    values[indices[-1]] = value
    if type(value) not in NUMBERS:
        bounded(root)


def _at(values: Any, indices: tuple[Any, ...]) -> Any:
    for index in indices:
        values = item(values, index)
    return values


def truth(value: Any) -> bool:
    """Return a condition: True, False, or a number that is not 0 (UR's own control script asks so for a seed)."""
    if value is True or value is False:
        return value
    if type(value) in NUMBERS:
        return bool(value != 0)
    raise ScriptError(f"A condition must be True or False, it is {value!r}.")


def number(value: Any) -> Any:
    """Return the value, where it is a number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScriptError(f"Arithmetic needs a number, it got {value!r}.")
    return value


def added(left: Any, right: Any) -> Any:
    """left + right."""
    if type(left) in NUMBERS and type(right) in NUMBERS:
        return whole(left + right)
    return _each(operator.add, left, right)


def subtracted(left: Any, right: Any) -> Any:
    """left - right."""
    if type(left) in NUMBERS and type(right) in NUMBERS:
        return whole(left - right)
    return _each(operator.sub, left, right)


def multiplied(left: Any, right: Any) -> Any:
    """left * right: element by element, or the matrix product where the left side is a matrix and the right a list."""
    if type(left) in NUMBERS and type(right) in NUMBERS:
        return whole(left * right)
    if _is_matrix(left) and isinstance(right, list):
        Effort.spend(len(left) * len(left[0]) * (len(right[0]) if _is_matrix(right) else 1))
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


def method(root: Any, indices: tuple[Any, ...], name: str, *arguments: Any) -> Any:
    """root[i][j].name(...): what a list of variable length can do."""
    target = _at(root, indices)
    if not isinstance(target, list) or isinstance(target, Pose):
        raise ScriptError(f"Only a list has {name}().")
    if name == "append":
        target.append(*map(copied, arguments))
        if indices or type(target[-1]) not in NUMBERS or len(target) > MOST_PARTS:
            bounded(root)
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
        Effort.spend(len(left))
        if not _is_plain(right):
            return [_each(apply, part, right) for part in left]
        if len(left) != len(right):
            raise ScriptError(f"Lists of {len(left)} and {len(right)} have no sum, difference, product or quotient.")
        return [_each(apply, a, b) for a, b in zip(left, right, strict=True)]
    if _is_plain(right):
        Effort.spend(len(right))
        return [_each(apply, left, part) for part in right]
    return whole(apply(number(left), number(right)))


def _is_plain(value: Any) -> bool:
    return isinstance(value, list) and not isinstance(value, Pose)


def _is_matrix(value: Any) -> bool:
    return _is_plain(value) and bool(value) and all(_is_plain(row) for row in value)


def _inner(row: list[Any], column: Any) -> Any:
    if len(row) != len(column):
        raise ScriptError(f"A matrix with {len(row)} columns cannot multiply {len(column)} rows.")
    return whole(sum(number(a) * number(b) for a, b in zip(row, column, strict=True)))


def _quotient(left: Any, right: Any) -> Any:
    if right == 0:
        raise ScriptError("Division by zero.")
    return left / right


def _remainder(left: Any, right: Any) -> Any:
    if right == 0:
        raise ScriptError("Division by zero.")
    found = math.fmod(left, right)
    return int(found) if isinstance(left, int) and isinstance(right, int) else found


def text_of(value: Any) -> str:
    """What to_str, str_cat and textmsg make of a value: six significant digits, True, [1, 2], p[...]."""
    if isinstance(value, str):
        return value
    if isinstance(value, list | Struct):
        Effort.spend(10 * len(value))
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ("p" if isinstance(value, Pose) else "") + "[" + ", ".join(text_of(part) for part in value) + "]"
    if isinstance(value, Struct):
        return "struct(" + ", ".join(f"{name}={text_of(part)}" for name, part in value.items()) + ")"
    return str(value)


def str_cat(op1: Any, op2: Any) -> str:
    """Both operands as text, one after the other."""
    return str(bounded(text_of(op1) + text_of(op2)))


def str_len(str: str) -> int:
    """Number of characters."""
    return len(_text(str))


def str_empty(str: str) -> bool:
    """Return whether there is no character."""
    return not _text(str)


def str_at(src: str, index: int) -> str:
    """Return the character at `index`."""
    _position(src, index)
    return src[index]


def str_sub(src: str, index: int, len: int | None = None) -> str:
    """Return the part from `index` on, at most `len` characters; to the end where that is left out or negative."""
    _position(src, index)
    return src[index:] if len is None or len < 0 else src[index : index + len]


def str_find(src: str, target: str, start_from: int = 0) -> int:
    """Where `target` starts, or -1."""
    return _text(src).find(_text(target), start_from)


def to_num(str: str) -> int | float:
    """Return the number that a text starts with."""
    match = _NUMBER.match(_text(str))
    if match is None:
        raise ScriptError(f"to_num: {str!r} does not start with a number.")
    found = match.group().strip()
    return int(whole(int(found))) if re.fullmatch(r"[-+]?\d+", found) else float(found)


def length(v: Any) -> int:
    """Number of elements of a list, or characters of a text."""
    if not isinstance(v, list | str):
        raise ScriptError(f"length needs a list or a text, it got {v!r}.")
    return len(v)


def size(v: Any) -> Any:
    """Number of elements of a list; rows and columns of a matrix."""
    if isinstance(v, list) and v and isinstance(v[0], list):
        return [len(v), len(v[0])]
    return length(v)


def transpose(m: Any) -> Any:
    """Rows become columns."""
    if not isinstance(m, list) or not all(isinstance(row, list) for row in m):
        raise ScriptError("transpose needs a matrix.")
    return [list(column) for column in zip(*m, strict=True)]


def make_list(length: int, initial_value: Any = 0, capacity: int = 0) -> list[Any]:
    """Return a list of `length` equal elements."""
    if length > MOST_PARTS:
        raise ScriptError(f"A list has no more than {MOST_PARTS} elements.")
    parts = [initial_value] * int(length)
    bounded(parts)
    return list(copied(parts))


def binary_list_to_integer(l: Any) -> int:  # noqa: E741  (URScript's own name)
    """Return the number whose bits are in a list, the lowest first."""
    value = sum(1 << i for i, bit in enumerate(l[:32]) if bit)
    return value - (1 << 32) if len(l) == 32 and l[31] else value


def struct(**members: Any) -> Struct:
    """Return a struct with these members."""
    made: Struct = bounded(copied(Struct(members)))
    return made


TEXTS = {
    **{f.__name__: f for f in (str_cat, str_len, str_empty, str_at, str_sub, str_find, to_num)},
    **{f.__name__: f for f in (length, size, transpose, make_list, binary_list_to_integer, struct)},
    "to_str": text_of,
    "get_list_length": length,
}
"""By their URScript name."""


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ScriptError(f"A text is needed, this is {value!r}.")
    return value


def _position(text: Any, index: Any) -> None:
    if not 0 <= index < max(1, len(_text(text))):
        raise ScriptError(f"There is no character {index} in a text of {len(text)}.")
