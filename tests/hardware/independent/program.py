"""URScript programs of the independent controller, compiled to closures, and to generators where they block."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Generator
from typing import Any

from tests.hardware.independent.grammar import Parser, ScriptError

COMPARE = {
    "==": operator.eq, "!=": operator.ne, "<": operator.lt, ">": operator.gt, "<=": operator.le, ">=": operator.ge,
}  # fmt: skip
BREAK, CONTINUE, RETURN = "break", "continue", "return"
LONGEST_SLICE = 200_000  # statements without a pause; a controller stops such a program

Frame = dict[str, Any]
Code = Callable[[Frame], Any]


class Pose(list[float]):
    """p[x, y, z, rx, ry, rz]."""


def kind_of(value: Any) -> tuple[str, int]:
    """The type of a value, with the length of an array."""
    if isinstance(value, bool):
        return "bool", 0
    if isinstance(value, int | float):
        return "number", 0
    if isinstance(value, list):
        return "pose" if isinstance(value, Pose) else "array", len(value)
    return type(value).__name__, 0


class Program:
    """A compiled program; `run` is a generator that yields where the program blocks.

    Args:
        text: the program.
        builtins: functions of the controller by name; each returns its value.
        blocking: functions of the controller that take time: what they return is yielded.
    """

    def __init__(
        self, text: str, builtins: dict[str, Callable[..., Any]], blocking: dict[str, Callable[..., Any]]
    ) -> None:
        self._builtins, self._blocking = builtins, blocking
        _, self.name, names, body = Parser(text).program()
        if names:
            raise ScriptError("a program has no arguments")
        self._functions: dict[str, tuple[list[str], list[tuple[Any, ...]]]] = {}
        self._globals: set[str] = set()
        self._collect(body)
        self._slow = self._waiting_functions()
        self._compiled: dict[str, Code] = {}
        self._steps = 0
        self.values: Frame = {}
        for name, (arguments, inner) in self._functions.items():
            self._locals = set(arguments)
            self._compiled[name] = self._block(inner, name in self._slow)
        self._locals = set()
        self._main = self._block(body, True)

    def run(self) -> Generator[Any, None, None]:
        """Run the program. Raises ScriptError at a runtime error."""
        try:
            yield from self._main({})
        except (TypeError, ValueError, ArithmeticError, IndexError, RecursionError) as error:
            raise ScriptError(str(error)) from error

    def pause_over(self) -> None:
        """Count the steps of the next slice from zero."""
        self._steps = 0

    def _collect(self, body: list[Any]) -> None:
        for statement in body:
            match statement:
                case ("def", name, arguments, inner):
                    if name in self._functions or name in self._builtins or name in self._blocking:
                        raise ScriptError(f"{name} is defined twice")
                    self._functions[name] = (arguments, inner)
                    self._collect(inner)
                case ("global", _, name, _):
                    self._globals.add(name)
                case ("while", _, _, inner):
                    self._collect(inner)
                case ("if", _, branches, otherwise):
                    for _, inner in branches:
                        self._collect(inner)
                    self._collect(otherwise)

    def _waiting_functions(self) -> set[str]:
        """The functions that call, directly or not, a function of the controller that takes time."""
        calls = {name: _called(inner) for name, (_, inner) in self._functions.items()}
        slow = set(self._blocking)
        while more := {name for name, called in calls.items() if called & slow} - slow:
            slow |= more
        return slow

    def _block(self, body: list[Any], slow: bool) -> Code:
        pairs = []
        for statement in body:
            if statement[0] == "def":
                continue
            waits = bool(_called([statement]) & self._slow)
            pairs.append((waits, self._statement(statement, waits)))
        if not slow:
            codes = [code for _, code in pairs]

            def plain(frame: Frame) -> Any:
                for code in codes:
                    if (left := code(frame)) is not None:
                        return left
                return None

            return plain

        def waiting(frame: Frame) -> Any:
            for waits, code in pairs:
                left = (yield from code(frame)) if waits else code(frame)
                if left is not None:
                    return left
            return None

        return waiting

    def _statement(self, statement: Any, waits: bool) -> Code:
        code = self._kind(statement, waits)
        line = statement[1]

        def counted(frame: Frame) -> Any:
            self._steps += 1
            if self._steps > LONGEST_SLICE:
                raise ScriptError(f"line {line}: the program runs without a pause")
            return code(frame)

        return counted

    def _kind(self, statement: Any, waits: bool) -> Code:
        match statement:
            case ("if", _, branches, otherwise):
                cases = [(self._value(test), self._block(inner, waits)) for test, inner in branches]
                cases.append((lambda _: True, self._block(otherwise, waits)))

                def choose(frame: Frame) -> Any:
                    return next(inner for test, inner in cases if _truth(test(frame)))(frame)

                return choose
            case ("while", _, test, inner):
                return self._while(self._value(test), self._block(inner, waits), waits)
            case ("return", _, value):
                result = self._value(value) if value else lambda _: None
                return lambda frame: (RETURN, result(frame))
            case ("break" | "continue" as word, _):
                return lambda _: (word, None)
            case ("halt", _):
                return _halt
            case ("do", _, call):
                return self._call(call, waits)
            case ("global" | "local" as scope, _, name, value):
                if scope == "local":
                    self._locals.add(name)
                return self._assign(("name", name), value or ("value", None), scope)
            case ("assign", _, target, value):
                if waits:
                    raise ScriptError("a function that takes time can only be called by itself")
                return self._assign(target, value, "")
        raise ScriptError(f"no such statement: {statement[0]}")

    @staticmethod
    def _while(test: Code, inner: Code, waits: bool) -> Code:
        if waits:

            def slow(frame: Frame) -> Any:
                while _truth(test(frame)):
                    left = yield from inner(frame)
                    if left is not None and left[0] != CONTINUE:
                        return None if left[0] == BREAK else left
                return None

            return slow

        def quick(frame: Frame) -> Any:
            while _truth(test(frame)):
                left = inner(frame)
                if left is not None and left[0] != CONTINUE:
                    return None if left[0] == BREAK else left
            return None

        return quick

    def _assign(self, target: Any, value: Any, scope: str) -> Code:
        source = self._value(value)
        if target[0] == "index":
            whole, at = self._value(target[1]), self._value(target[2])

            def put(frame: Frame) -> None:
                array, index = whole(frame), at(frame)
                if not 0 <= index < len(array):
                    raise ScriptError(f"index {index} is outside an array of {len(array)}")
                array[index] = source(frame)

            return put
        name = target[1]
        everywhere = scope == "global" or (scope == "" and name not in self._locals and name in self._globals)

        def give(frame: Frame) -> None:
            held = self.values if everywhere else frame
            found = source(frame)
            if isinstance(found, list):
                found = type(found)(found)
            if name in held and held[name] is not None and kind_of(held[name]) != kind_of(found) and scope != "local":
                raise ScriptError(f"{name} is a {kind_of(held[name])} and cannot become a {kind_of(found)}")
            held[name] = found

        return give

    def _call(self, call: Any, waits: bool) -> Code:
        _, name, given = call
        arguments = [self._value(one) for one in given]
        if name in self._functions:
            names, _ = self._functions[name]
            if len(names) != len(arguments):
                raise ScriptError(f"{name} takes {len(names)} arguments, not {len(arguments)}")
            compiled = self._compiled
            if name not in self._slow:

                def plain(frame: Frame) -> None:
                    compiled[name]({n: a(frame) for n, a in zip(names, arguments, strict=True)})

                return plain

            def slow(frame: Frame) -> Any:
                yield from compiled[name]({n: a(frame) for n, a in zip(names, arguments, strict=True)})

            return slow
        if name in self._blocking:
            function = self._blocking[name]

            def wait(frame: Frame) -> Any:
                yield function(*[a(frame) for a in arguments])

            return wait
        value = self._value(call)

        def done(frame: Frame) -> None:
            value(frame)

        return done

    def _value(self, expression: Any) -> Code:
        match expression:
            case ("value", constant):
                return lambda _: constant
            case ("list", parts):
                values = [self._value(part) for part in parts]
                return lambda frame: [value(frame) for value in values]
            case ("pose", parts):
                values = [self._value(part) for part in parts]
                return lambda frame: Pose(value(frame) for value in values)
            case ("not", inner):
                value = self._value(inner)
                return lambda frame: not _truth(value(frame))
            case ("logic", word, left, right):
                a, b = self._value(left), self._value(right)
                if word == "and":
                    return lambda frame: _truth(a(frame)) and _truth(b(frame))
                if word == "or":
                    return lambda frame: _truth(a(frame)) or _truth(b(frame))
                return lambda frame: _truth(a(frame)) != _truth(b(frame))
            case ("compare", word, left, right):
                a, b, compare = self._value(left), self._value(right), COMPARE[word]
                return lambda frame: compare(a(frame), b(frame))
            case ("sum", word, left, right):
                a, b, operation = self._value(left), self._value(right), SUMS[word]
                return lambda frame: operation(a(frame), b(frame))
            case ("index", whole, at):
                a, b = self._value(whole), self._value(at)
                return lambda frame: _item(a(frame), b(frame))
            case ("name", name):
                if name not in self._locals and name in self._globals:
                    values = self.values
                    return lambda _: _found(values, name)
                return lambda frame: _found(frame, name)
            case ("call", name, given):
                return self._function(name, [self._value(one) for one in given])
        raise ScriptError(f"no such expression: {expression[0]}")

    def _function(self, name: str, arguments: list[Code]) -> Code:
        if name in self._slow:
            raise ScriptError(f"{name} takes time and cannot be part of an expression")
        if name in self._functions:
            names, _ = self._functions[name]
            if len(names) != len(arguments):
                raise ScriptError(f"{name} takes {len(names)} arguments, not {len(arguments)}")
            compiled = self._compiled

            def value(frame: Frame) -> Any:
                left = compiled[name]({n: a(frame) for n, a in zip(names, arguments, strict=True)})
                return None if left is None else left[1]

            return value
        if name not in self._builtins:
            raise ScriptError(f"{name} is not defined")
        function = self._builtins[name]
        return lambda frame: function(*[a(frame) for a in arguments])


class Halt(Exception):
    """The program ends itself."""


def _halt(_: Frame) -> Any:
    raise Halt


def _called(body: list[Any]) -> set[str]:
    """The names of all functions that are called in statements, without those inside of definitions."""
    found, left = set[str](), list(body)
    while left:
        one = left.pop()
        if isinstance(one, tuple):
            if one and one[0] == "def":
                continue
            if one and one[0] == "call":
                found.add(one[1])
            left.extend(one)
        elif isinstance(one, list):
            left.extend(one)
    return found


def _truth(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ScriptError(f"a condition must be True or False, not {value!r}")
    return value


def _found(values: Frame, name: str) -> Any:
    try:
        return values[name]
    except KeyError:
        raise ScriptError(f"{name} has no value") from None


def _item(array: Any, index: Any) -> Any:
    if not isinstance(array, list) or isinstance(index, bool) or not 0 <= index < len(array):
        raise ScriptError(f"there is no item {index!r}")
    return array[index]


def _arithmetic(operation: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    def calculate(a: Any, b: Any) -> Any:
        if kind_of(a)[0] != "number" or kind_of(b)[0] != "number":
            raise ScriptError(f"no arithmetic with {a!r} and {b!r}")
        return operation(a, b)

    return calculate


SUMS = {
    "+": _arithmetic(operator.add),
    "-": _arithmetic(operator.sub),
    "*": _arithmetic(operator.mul),
    "/": _arithmetic(operator.truediv),
    "%": _arithmetic(math.fmod),
}
