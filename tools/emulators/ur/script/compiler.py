"""Compiles a URScript tree into Python generator functions; each yields at the end of its 2 ms slice.

Variables assigned in the main body or declared global are global, all others belong to their routine. URScript names
are prefixed (v_, f_, b_), since scripts call variables `async` or `time`. Assignment copies lists.
"""

from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass
from types import CodeType
from typing import Any

from weldcal.tools.emulators.ur.script import arithmetic, syntax
from weldcal.tools.emulators.ur.script.syntax import Expression, Routine, ScriptError, Statement

SOURCE_NAME = "<urscript>"
_OPERATORS = {"+": "added", "-": "subtracted", "*": "multiplied", "/": "divided", "%": "remainder"}
_LOGICAL = ("not", "and", "or", "xor")
_BOOLEAN = (*_LOGICAL, "==", "!=", "<", "<=", ">", ">=")
_HELPERS = ("Pose", "copied", "listed", "item", "place", "truth", "negated", "number", "method")
_SHARED = syntax.Name | syntax.Index | syntax.CallExpression | syntax.Method  # values that somebody else may hold
_SPEND = f"spend({arithmetic.LOOP_EFFORT})"
Slices = Generator[None, None, Any]


class Halted(Exception):  # the script's own `halt`, not an error
    """The script ended itself."""


@dataclass(frozen=True)
class Compiled:
    """The main generator function, the routines that `run` may start, and the URScript line of each generated line."""

    name: str
    kind: str
    main: Callable[[], Slices]
    lines: tuple[int, ...]


@dataclass(frozen=True)
class Hooks:
    """What compiled code calls back: start, kill and join of a thread."""

    run: Callable[[Slices, str], int]
    kill: Callable[[Any], None]
    alive: Callable[[Any], bool]


@dataclass(frozen=True)
class Translation:
    """A program as Python code, before it is bound to one controller; `lines` as in `Compiled`."""

    name: str
    kind: str
    code: CodeType
    lines: tuple[int, ...]


def translate(routine: Routine, builtins: frozenset[str], blocking: frozenset[str]) -> Translation:
    """Raises ScriptError where a name is called that neither the script nor the controller defines."""
    emitter = _Emitter(routine, builtins, blocking)
    emitter.program()
    code = compile("\n".join(emitter.text), SOURCE_NAME, "exec")
    return Translation(routine.name, routine.kind, code, tuple(emitter.lines))


def bind(translation: Translation, builtins: Mapping[str, Callable[..., Any]], hooks: Hooks) -> Compiled:
    """Return the program with the controller's functions, with variables of its own."""
    namespace: dict[str, Any] = {f"b_{name}": function for name, function in builtins.items()}
    namespace |= {name: getattr(arithmetic, name) for name in (*_OPERATORS.values(), *_HELPERS)}
    namespace |= {
        "Halted": Halted,
        "spend": arithmetic.Effort.spend,
        "start": hooks.run,
        "kill": hooks.kill,
        "alive": hooks.alive,
    }
    exec(translation.code, namespace)
    return Compiled(translation.name, translation.kind, namespace["main"], translation.lines)


class _Emitter:
    def __init__(self, routine: Routine, builtins: frozenset[str], blocking: frozenset[str]) -> None:
        self._routine = routine
        self._builtins = builtins
        self._blocking = blocking
        self._routines: dict[str, Routine] = {}
        self._collect(routine.inner)
        self._globals = _assigned(routine.body) | _declared(routine.body)
        for inner in self._routines.values():
            self._globals |= _declared(inner.body)
        self.text: list[str] = []
        self.lines: list[int] = []
        self._line = routine.line

    def _collect(self, routines: tuple[Routine, ...]) -> None:
        for inner in routines:
            self._routines[inner.name] = inner
            self._collect(inner.inner)

    def emit(self, depth: int, text: str) -> None:
        self.text.append("    " * depth + text)
        self.lines.append(self._line)

    def program(self) -> None:
        for inner in self._routines.values():
            self._function(inner)
        self._line = self._routine.line
        self.emit(0, "def main():")
        self._scope(self._globals)
        self._body(self._routine.body, 1)

    def _function(self, routine: Routine) -> None:
        self._line = routine.line
        parameters = [
            f"v_{name}" if default is None else f"v_{name}={self.value(default)}"
            for name, default in routine.parameters
        ]
        self.emit(0, f"def f_{routine.name}({', '.join(parameters)}):")
        own = {name for name, _ in routine.parameters} | _declared(routine.body, "local")
        self._scope((self._globals & _assigned(routine.body)) - own)
        self.emit(1, _SPEND)
        self._body(routine.body, 1)

    def _scope(self, names: Iterable[str]) -> None:
        listed = ", ".join(f"v_{name}" for name in sorted(names))
        if listed:
            self.emit(1, f"global {listed}")
        # a function with a yield is a generator, even where its script never gives up its slice
        self.emit(1, "if False: yield")

    def _body(self, statements: tuple[Statement, ...], depth: int) -> None:
        for statement in statements:
            self._statement(statement, depth)
        if not statements:
            self.emit(depth, "pass")

    def _statement(self, statement: Statement, depth: int) -> None:
        self._line = statement.line
        match statement:
            case syntax.Assign():
                self._assign(statement, depth)
            case syntax.Evaluate(value=value):
                self.emit(depth, self.value(value))
            case syntax.Conditional(branches=branches, otherwise=otherwise):
                for i, (condition, body) in enumerate(branches):
                    # `elif` whose condition calls a routine stays correct: Python evaluates it only when it is reached
                    self.emit(depth, f"{'elif' if i else 'if'} {self._truth(condition)}:")
                    self._body(body, depth + 1)
                if otherwise:
                    self.emit(depth, "else:")
                    self._body(otherwise, depth + 1)
            case syntax.Loop(condition=condition, body=body):
                self.emit(depth, f"while {self._truth(condition)}:")
                self.emit(depth + 1, _SPEND)
                self._body(body, depth + 1)
            case syntax.ControlStatement():
                self._command(statement, depth)

    def _assign(self, statement: syntax.Assign, depth: int) -> None:
        value = self.value(statement.value)
        if isinstance(statement.value, _SHARED):
            value = f"copied({value})"
        if statement.name == "digital_out" and len(statement.indices) == 1:
            # what older programs write; the name is the controller's
            self.emit(depth, f"b_set_digital_out({self.value(statement.indices[0])}, {value})")
            return
        if not statement.indices:
            self.emit(depth, f"v_{statement.name} = {value}")
            return
        indices = "".join(f"{self.value(index)}, " for index in statement.indices)
        self.emit(depth, f"place(v_{statement.name}, ({indices}), {value})")

    def _command(self, statement: syntax.ControlStatement, depth: int) -> None:
        value = self.value(statement.value) if statement.value is not None else ""
        match statement.word:
            case "halt":
                self.emit(depth, "raise Halted")
            case "kill":
                self.emit(depth, f"kill({value})")
            case "join":
                self.emit(depth, f"joined = {value}")
                self.emit(depth, "while alive(joined): yield")
            case "enter_critical" | "exit_critical":
                # threads change places only where a slice ends, and a slice ends a critical section's protection
                self.emit(depth, "pass")
            case word:
                self.emit(depth, f"{word} {value}".rstrip())

    def value(self, expression: Expression) -> str:
        match expression:
            case syntax.Literal(value=value):
                return repr(value)
            case syntax.Name(name=name):
                return f"v_{name}"
            case syntax.Items(items=items, pose=pose):
                listed = ", ".join(self.value(item) for item in items)
                plain = all(isinstance(item, syntax.Literal) for item in items)
                listed = f"[{listed}]" if plain else f"listed({listed})"
                return f"Pose({listed})" if pose else listed
            case syntax.Index(target=target, index=index):
                return f"item({self.value(target)}, {self.value(index)})"
            case syntax.CallExpression():
                return self._call(expression)
            case syntax.Method(target=target, name=name, arguments=arguments):
                indices: list[str] = []
                while isinstance(target, syntax.Index):
                    indices.insert(0, f"{self.value(target.index)}, ")
                    target = target.target
                listed = ", ".join([repr(name), *map(self.value, arguments)])
                return f"method({self.value(target)}, ({''.join(indices)}), {listed})"
            case syntax.Operation(operator=operator, operands=operands):
                if operator in _LOGICAL:
                    return self._logical(operator, [self._truth(operand) for operand in operands])
                return self._operation(operator, [self.value(operand) for operand in operands])

    def _truth(self, expression: Expression) -> str:
        """Return the expression as a condition.

        What can only be True or False is not asked what it is, a hundred times a frame.
        """
        value = self.value(expression)
        boolean = isinstance(expression, syntax.Operation) and expression.operator in _BOOLEAN
        return value if boolean else f"truth({value})"

    def _logical(self, operator: str, values: list[str]) -> str:
        if operator == "not":
            return f"(not {values[0]})"
        return f"({values[0]} {'!=' if operator == 'xor' else operator} {values[1]})"

    def _operation(self, operator: str, values: list[str]) -> str:
        if len(values) == 1:
            return f"negated({values[0]})" if operator == "-" else values[0]
        left, right = values
        if operator in _OPERATORS:
            return f"{_OPERATORS[operator]}({left}, {right})"
        return f"({left} {operator} {right})"

    def _call(self, call: syntax.CallExpression) -> str:
        if call.name in self._routines:
            arguments = [self._own(argument) for argument in call.arguments]
            arguments += [f"v_{key}={self._own(value)}" for key, value in call.keywords]
            made = f"f_{call.name}({', '.join(arguments)})"
            if call.run:
                if self._routines[call.name].kind != "thread":
                    raise ScriptError(f"Line {self._line}: {call.name} is not a thread and cannot be run.", self._line)
                return f"start({made}, {call.name!r})"
            return f"(yield from {made})"
        if call.name not in self._builtins or call.run:
            raise ScriptError(f"compile_error_name_not_found:{call.name}:", call.line, call.column)
        arguments = [self.value(argument) for argument in call.arguments]
        arguments += [f"{key}={self.value(value)}" for key, value in call.keywords]
        made = f"b_{call.name}({', '.join(arguments)})"
        return f"(yield from {made})" if call.name in self._blocking else made

    def _own(self, expression: Expression) -> str:
        value = self.value(expression)
        return f"copied({value})" if isinstance(expression, _SHARED) else value


def _walk(statements: tuple[Statement, ...]) -> Iterable[syntax.Assign]:
    for statement in statements:
        if isinstance(statement, syntax.Assign):
            yield statement
        elif isinstance(statement, syntax.Conditional):
            for _, body in statement.branches:
                yield from _walk(body)
            yield from _walk(statement.otherwise)
        elif isinstance(statement, syntax.Loop):
            yield from _walk(statement.body)


def _assigned(statements: tuple[Statement, ...]) -> set[str]:
    return {assign.name for assign in _walk(statements) if not assign.indices}


def _declared(statements: tuple[Statement, ...], scope: str = "global") -> set[str]:
    return {assign.name for assign in _walk(statements) if assign.scope == scope}
