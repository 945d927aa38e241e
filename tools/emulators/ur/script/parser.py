"""Splits URScript text into tokens, and parses them into a tree."""

import dataclasses
import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from weldcal.tools.emulators.ur.script import syntax
from weldcal.tools.emulators.ur.script.arithmetic import LARGEST
from weldcal.tools.emulators.ur.script.syntax import Expression, Routine, ScriptError, Statement

OPENING = frozenset({"def", "thread", "sec", "if", "while"})
KEYWORDS = OPENING | {
    *("elif", "else", "end", "global", "local", "return", "break", "continue", "halt", "pass", "run", "kill", "join"),
    *("and", "or", "not", "xor", "True", "False", "enter_critical", "exit_critical"),
}
_TOKEN = re.compile(
    r"""(?P<space>[ \t\r;]+|\#[^\n]*|\$[^\n]*)
      | (?P<newline>\n)
      | (?P<number>(\d+\.\d*|\.\d+|\d+)([eE][+-]?\d+)?)
      | (?P<text>"[^"\n]*")
      | (?P<word>[A-Za-z_][A-Za-z_0-9]*)
      | (?P<sign>==|!=|<=|>=|[-+*/%<>=()\[\],:.])""",
    re.VERBOSE,
)
# Loosest first, as the URScript manual orders them; `not` binds tighter than `and`.
_BINARY = (("or",), ("xor",), ("and",), ("==", "!="), ("<", ">", "<=", ">="), ("+", "-"), ("*", "/", "%"))


@dataclass(frozen=True)
class Token:
    """kind is newline, number, text, word, keyword, sign or end; line and column count from 1."""

    kind: str
    text: str
    line: int
    column: int = 0


def tokenize(source: str) -> list[Token]:
    """Return all tokens, comments and labels ($ lines) left out, one token of kind `end` at the end.

    Raises:
        ScriptError: a character that no URScript word starts with.
    """
    tokens: list[Token] = []
    position, line, line_start = 0, 1, 0
    while position < len(source):
        column = position - line_start + 1
        match = _TOKEN.match(source, position)
        if match is None:
            raise ScriptError(
                f"The script has an unexpected character {source[position]!r} in line {line}.", line, column
            )
        kind, text = str(match.lastgroup), match.group()
        position = match.end()
        if kind == "newline":
            tokens.append(Token(kind, text, line, column))
            line, line_start = line + 1, position
        elif kind != "space":
            tokens.append(Token("keyword" if text in KEYWORDS else kind, text, line, column))
    tokens.append(Token("end", "", line))
    return tokens


def split_programs(buffer: str) -> tuple[list[str], str]:
    """Return the complete programs at the start of what has arrived, and the rest that waits for more.

    A program is a def or sec with its matching `end`, in whatever column, or a single line.
    """
    programs: list[str] = []
    while True:
        buffer = buffer.lstrip()
        if "\n" not in buffer:
            return programs, buffer
        length = _program_length(buffer)
        if length is None:
            return programs, buffer
        programs.append(buffer[:length])
        buffer = buffer[length:]


def _program_length(buffer: str) -> int | None:
    first_line = buffer.split("\n", 1)[0]
    if first_line.split(" ", 1)[0] not in ("def", "sec"):
        return len(first_line) + 1
    depth, position = 0, 0
    while position < len(buffer):
        match = _TOKEN.match(buffer, position)
        if match is None:
            position += 1
            continue
        position = match.end()
        if match.lastgroup == "word":
            if match.group() in OPENING:
                depth += 1
            elif match.group() == "end":
                depth -= 1
                if depth == 0:
                    # an `end` that is the last thing to have arrived may be the start of a longer word
                    return position if position < len(buffer) else None
    return None


def parse_program(source: str) -> Routine:
    """Return the one def or sec of `source`, or a single line as a program of its own.

    Raises:
        ScriptError: the text is not a program of the subset.
    """
    words = source.split(None, 1)
    if words and words[0] not in ("def", "sec"):
        body, inner = _Parser(tokenize(source)).block(frozenset())
        return Routine(1, "def", "line", (), body, inner)
    parser = _Parser(tokenize(source))
    parser.skip_newlines()
    routine = parser.routine()
    parser.skip_newlines()
    if parser.token.kind != "end":
        raise parser.error("a second program")
    return routine


class _Parser:
    def __init__(self, tokens: list[Token]) -> None:
        self._tokens = tokens
        self._position = self._loops = 0

    @property
    def token(self) -> Token:
        return self._tokens[self._position]

    def error(self, found: str | None = None) -> ScriptError:
        what = found or repr(self.token.text or "the end")
        return ScriptError(
            f"Syntax error in line {self.token.line}: {what} does not belong there.", self.token.line, self.token.column
        )

    def take(self) -> Token:
        token = self.token
        if token.kind != "end":
            self._position += 1
        return token

    def at(self, *texts: str) -> bool:
        return self.token.kind in ("sign", "keyword") and self.token.text in texts

    def expect(self, text: str) -> Token:
        if not self.at(text):
            raise self.error()
        return self.take()

    def word(self) -> str:
        if self.token.kind != "word":
            raise self.error()
        return self.take().text

    def skip_newlines(self) -> None:
        while self.token.kind == "newline":
            self._position += 1

    def routine(self) -> Routine:
        opening = self.take()
        if opening.text not in ("def", "thread", "sec"):
            raise self.error(repr(opening.text))
        name = self.word()
        self.expect("(")
        parameters: list[tuple[str, Expression | None]] = []
        while not self.at(")"):
            if self.token.text in (known for known, _ in parameters):
                raise self.error(f"a second parameter {self.token.text!r}")
            parameter, default = self.word(), None
            if self.at("="):
                self.take()
                default = self.expression()
            parameters.append((parameter, default))
            if not self.at(")"):
                self.expect(",")
        self.expect(")")
        self.expect(":")
        body, inner = self.block(frozenset({"end"}))
        self.expect("end")
        return Routine(opening.line, opening.text, name, tuple(parameters), body, inner)

    def block(self, closing: frozenset[str]) -> tuple[tuple[Statement, ...], tuple[Routine, ...]]:
        statements: list[Statement] = []
        inner: list[Routine] = []
        while True:
            self.skip_newlines()
            if self.token.kind == "end":
                if closing:
                    raise ScriptError(f"Line {self.token.line}: a block is not closed by `end`.", self.token.line)
                return tuple(statements), tuple(inner)
            if self.token.kind == "keyword" and self.token.text in closing:
                return tuple(statements), tuple(inner)
            if self.at("def", "thread", "sec"):
                inner.append(self.routine())
            else:
                statements.append(self.statement())

    def statements(self, *closing: str) -> tuple[Statement, ...]:
        body, inner = self.block(frozenset(closing))
        if inner:
            raise ScriptError(f"Line {inner[0].line}: define {inner[0].name} outside of if and while.", inner[0].line)
        return body

    def statement(self) -> Statement:
        line = self.token.line
        if self.at("if"):
            return self.conditional()
        if self.at("while"):
            self.take()
            condition = self.expression()
            self.expect(":")
            self._loops += 1
            body = self.statements("end")
            self._loops -= 1
            self.expect("end")
            return syntax.Loop(line, condition, body)
        if self.at("break", "continue", "halt", "pass", "enter_critical", "exit_critical"):
            if not self._loops and self.at("break", "continue"):
                raise self.error(f"{self.token.text!r} outside of a loop")
            word = self.take().text
            if self.at("("):
                self.take()
                self.expect(")")
            return syntax.ControlStatement(line, word)
        if self.at("kill", "join"):
            return syntax.ControlStatement(line, self.take().text, self.expression())
        if self.at("return"):
            self.take()
            nothing = self.token.kind in ("newline", "end") or self.at("end", "else", "elif")
            return syntax.ControlStatement(line, "return", None if nothing else self.expression())
        scope = self.take().text if self.at("global", "local") else ""
        target = self.expression()
        if self.at("="):
            self.take()
            return self._assignment(line, target, scope)
        if scope:
            raise self.error()
        return syntax.Evaluate(line, target)

    def _assignment(self, line: int, target: Expression, scope: str) -> syntax.Assign:
        indices: list[Expression] = []
        while isinstance(target, syntax.Index):
            indices.append(target.index)
            target = target.target
        if not isinstance(target, syntax.Name):
            raise self.error("the left side of =")
        return syntax.Assign(line, target.name, tuple(reversed(indices)), self.expression(), scope)

    def conditional(self) -> syntax.Conditional:
        line = self.take().line
        branches: list[tuple[Expression, tuple[Statement, ...]]] = []
        otherwise: tuple[Statement, ...] = ()
        while True:
            condition = self.expression()
            self.expect(":")
            branches.append((condition, self.statements("elif", "else", "end")))
            if not self.at("elif"):
                break
            self.take()
        if self.at("else"):
            self.take()
            self.expect(":")
            otherwise = self.statements("end")
        self.expect("end")
        return syntax.Conditional(line, tuple(branches), otherwise)

    def expression(self, level: int = 0) -> Expression:
        if level == len(_BINARY):
            return self.unary()
        left = self.expression(level + 1)
        while self.at(*_BINARY[level]):
            operator = self.take().text
            left = syntax.Operation(operator, (left, self.expression(level + 1)))
        return left

    def unary(self) -> Expression:
        self.skip_newlines()
        if self.at("not", "-", "+"):
            operator = self.take().text
            return syntax.Operation(operator, (self.unary(),))
        return self.postfix()

    def postfix(self) -> Expression:
        value = self.primary()
        while self.at("[", "."):
            if self.take().text == ".":
                value = self.member(value)
                continue
            value = syntax.Index(value, self.expression())
            while self.at(","):
                # a matrix: m[row, column]
                self.take()
                value = syntax.Index(value, self.expression())
            self.expect("]")
        return value

    def member(self, target: Expression) -> Expression:
        name = self.word()
        if not self.at("("):
            return syntax.Index(target, syntax.Literal(name))
        self.take()
        return syntax.Method(target, name, self.items(")"))

    def primary(self) -> Expression:
        token = self.take()
        if token.kind == "number":
            if (number := float(token.text)) >= LARGEST and (token.text.isdigit() or number == math.inf):
                raise ScriptError(f"Line {token.line}: {token.text[:20]}... is too large.", token.line, token.column)
            return syntax.Literal(int(token.text) if token.text.isdigit() else number)
        if token.kind == "text":
            return syntax.Literal(token.text[1:-1])
        if token.text in ("True", "False"):
            return syntax.Literal(token.text == "True")
        if token.text == "(":
            value = self.expression()
            self.expect(")")
            return value
        if token.text == "[":
            return syntax.Items(self.items("]"), pose=False)
        if token.text == "run":
            call = self.primary()
            if not isinstance(call, syntax.CallExpression):
                raise self.error("what follows run")
            return dataclasses.replace(call, run=True)
        if token.kind == "word":
            return self.named(token)
        self._position -= token.kind != "end"
        raise self.error()

    def named(self, token: Token) -> Expression:
        if self.at("("):
            return self.call(token)
        if token.text == "p" and self.at("["):
            # p[0] reads a variable that somebody called p; six numbers are a pose
            self.take()
            items = self.items("]")
            if len(items) == 1:
                return syntax.Index(syntax.Name("p"), items[0])
            if len(items) != 6:
                raise self.error("a pose that has not six numbers")
            return syntax.Items(items, pose=True)
        return syntax.Name(token.text)

    def call(self, name: Token) -> syntax.CallExpression:
        self.expect("(")
        arguments: list[Expression] = []
        keywords: list[tuple[str, Expression]] = []

        def take_one() -> None:
            following = self._tokens[min(self._position + 1, len(self._tokens) - 1)]
            if self.token.kind == "word" and following.text == "=":
                key = self.word()
                if key in (known for known, _ in keywords):
                    raise self.error(f"a second {key!r}")
                self.take()
                keywords.append((key, self.expression()))
            elif keywords:
                raise self.error("a positional argument after a named one")
            else:
                arguments.append(self.expression())

        self.listed(")", take_one)
        return syntax.CallExpression(name.text, tuple(arguments), tuple(keywords), line=name.line, column=name.column)

    def items(self, closing: str) -> tuple[Expression, ...]:
        found: list[Expression] = []
        self.listed(closing, lambda: found.append(self.expression()))
        return tuple(found)

    def listed(self, closing: str, take_one: Callable[[], object]) -> None:
        """Items with commas between them, newlines allowed, up to and with the closing sign."""
        self.skip_newlines()
        while not self.at(closing):
            take_one()
            self.skip_newlines()
            if not self.at(closing):
                self.expect(",")
                self.skip_newlines()
        self.expect(closing)
