"""The grammar of URScript for the independent controller: words, framing on a script port, and a recursive-descent
parser.

Source: Universal Robots, "The URScript Programming Language for e-Series", chapters on numbers and types, flow of
control, functions, scoping rules. Of two readings the stricter one is taken: a variable keeps its type, an array its
length, and a function finds no local variable of another function.
"""

from __future__ import annotations

import re
from typing import Any

KEYWORDS = {
    "and", "break", "continue", "def", "elif", "else", "end", "False", "global", "halt", "if", "local", "not", "or", "return",
    "sec", "thread", "True", "while", "xor",
}  # fmt: skip
TOKEN = re.compile(
    r"(?P<space>["
    r" \t\r]+|\#[^\n]*)|(?P<line>\n)|(?P<number>(?:\d+\.\d*|\.\d+|\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)"
    r'|(?P<text>"[^"\n]*")|(?P<sign>==|!=|<=|>=|[-+*/%<>=(),:\[\]])'
)
COMPARISONS = ("==", "!=", "<", ">", "<=", ">=")


class ScriptError(Exception):
    """The program cannot be compiled, or ended with a runtime error."""


class Token:
    """A word of the program."""

    __slots__ = ("kind", "line", "text")

    def __init__(self, kind: str, text: str, line: int) -> None:
        self.kind, self.text, self.line = kind, text, line


def tokens_of(text: str) -> list[Token]:
    """The words of a program. Raises ScriptError at a character that no word has."""
    found, at, line = [], 0, 1
    while at < len(text):
        match = TOKEN.match(text, at)
        if match is None:
            raise ScriptError(f"line {line}: unexpected character {text[at]!r}")
        kind, word = str(match.lastgroup), match[0]
        at = match.end()
        if kind == "line":
            line += 1
        elif kind != "space":
            found.append(Token("keyword" if word in KEYWORDS else kind, word, line))
    found.append(Token("end of text", "", line + 1))
    return found


def complete_programs(text: str) -> tuple[list[str], str]:
    """The complete programs at the start of a script port's data, and the rest.

    A line outside of a program is one by itself.
    """
    programs: list[str] = []
    lines, depth = text.split("\n"), 0
    begun: list[str] = []
    for line in lines[:-1]:
        bare = re.sub(r'"[^"]*"|#.*', "", line)
        for word in re.findall(r"[A-Za-z_]\w*", bare):
            depth += (word in ("def", "sec", "thread", "if", "while")) - (word == "end")
        if depth > 0 or begun:
            begun.append(line)
            if depth <= 0:
                programs.append("\n".join(begun) + "\n")
                begun, depth = [], 0
        else:
            depth = 0
            if bare.strip():
                programs.append(line.strip())
    return programs, "\n".join([*begun, lines[-1]])


class Parser:
    """Reads a program into nested tuples. A new line separates where both readings are possible."""

    def __init__(self, text: str) -> None:
        self._tokens, self._at = tokens_of(text), 0

    @property
    def _next(self) -> Token:
        return self._tokens[self._at]

    def _take(self) -> Token:
        self._at += 1
        return self._tokens[self._at - 1]

    def _is(self, *words: str) -> bool:
        return self._next.text in words and self._next.kind in ("sign", "keyword")

    def _same_line(self) -> bool:
        return self._at > 0 and self._tokens[self._at - 1].line == self._next.line

    def _expect(self, word: str) -> Token:
        if not self._is(word):
            raise ScriptError(f"line {self._next.line}: {word!r} expected, not {self._next.text!r}")
        return self._take()

    def _name(self) -> str:
        if self._next.kind != "name":
            raise ScriptError(f"line {self._next.line}: a name expected, not {self._next.text!r}")
        return self._take().text

    def program(self) -> tuple[Any, ...]:
        """The definition of the program."""
        if not self._is("def", "sec"):
            raise ScriptError(f"line {self._next.line}: a program begins with def")
        found = self._definition()
        if self._next.kind != "end of text":
            raise ScriptError(f"line {self._next.line}: text after the program's end")
        return found

    def _definition(self) -> tuple[Any, ...]:
        self._take()
        name, names = self._name(), []
        self._expect("(")
        while not self._is(")"):
            names.append(self._name())
            if not self._is(")"):
                self._expect(",")
        self._take()
        self._expect(":")
        if len(set(names)) < len(names):
            raise ScriptError(f"{name}: an argument's name is given twice")
        body = self._block("end")
        self._take()
        return ("def", name, names, body)

    def _block(self, *ends: str) -> list[tuple[Any, ...]]:
        found = []
        while not self._is(*ends):
            if self._next.kind == "end of text":
                raise ScriptError(f"line {self._next.line}: end is missing")
            found.append(self._statement())
        return found

    def _statement(self) -> tuple[Any, ...]:
        word, line = self._next.text, self._next.line
        if self._next.kind == "name":
            return self._simple(line)
        match word:
            case "def":
                return self._definition()
            case "if":
                return self._if()
            case "while":
                self._take()
                test = self._expression()
                self._expect(":")
                body = self._block("end")
                self._take()
                return ("while", line, test, body)
            case "return":
                self._take()
                empty = self._is("end") or not self._same_line()
                return ("return", line, None if empty else self._expression())
            case "break" | "continue" | "halt":
                return (self._take().text, line)
            case "global" | "local":
                self._take()
                name = self._name()
                if self._is("="):
                    self._take()
                    return (word, line, name, self._expression())
                return (word, line, name, None)
        raise ScriptError(f"line {line}: a statement expected, not {word!r}")

    def _simple(self, line: int) -> tuple[Any, ...]:
        target = self._postfix()
        if self._is("=") and target[0] in ("name", "index"):
            self._take()
            return ("assign", line, target, self._expression())
        if target[0] != "call":
            raise ScriptError(f"line {line}: an assignment or a call expected")
        return ("do", line, target)

    def _if(self) -> tuple[Any, ...]:
        line, branches, otherwise = self._next.line, [], []
        while self._is("if", "elif"):
            self._take()
            test = self._expression()
            self._expect(":")
            branches.append((test, self._block("elif", "else", "end")))
        if self._is("else"):
            self._take()
            self._expect(":")
            otherwise = self._block("end")
        self._expect("end")
        return ("if", line, branches, otherwise)

    def _expression(self) -> tuple[Any, ...]:
        left = self._binary(0)
        while self._is("or", "xor", "and"):
            # the manual gives no precedence of these: a program that mixes them without parentheses is refused
            word = self._take().text
            left = ("logic", word, left, self._binary(0))
            if self._is("or", "xor", "and") and not self._is(word):
                raise ScriptError(f"line {self._next.line}: put {word} in parentheses")
        return left

    def _binary(self, level: int) -> tuple[Any, ...]:
        levels = (COMPARISONS, ("+", "-"), ("*", "/", "%"))
        if level == len(levels):
            return self._unary()
        if level == 0 and self._is("not"):
            self._take()
            return ("not", self._binary(0))
        left = self._binary(level + 1)
        while self._is(*levels[level]) and self._same_line():
            word = self._take().text
            left = ("compare" if level == 0 else "sum", word, left, self._binary(level + 1))
        return left

    def _unary(self) -> tuple[Any, ...]:
        if self._is("-"):
            self._take()
            return ("sum", "-", ("value", 0), self._unary())
        return self._postfix()

    def _postfix(self) -> tuple[Any, ...]:
        found = self._primary()
        while self._is("(", "[") and self._same_line():
            if self._is("["):
                self._take()
                found = ("index", found, self._expression())
                self._expect("]")
            else:
                if found[0] != "name":
                    raise ScriptError(f"line {self._next.line}: only a name can be called")
                self._take()
                found = ("call", found[1], self._list(")"))
        return found

    def _list(self, end: str) -> list[tuple[Any, ...]]:
        found = []
        while not self._is(end):
            found.append(self._expression())
            if not self._is(end):
                self._expect(",")
        self._take()
        return found

    def _primary(self) -> tuple[Any, ...]:
        token = self._take()
        if token.kind == "number":
            return ("value", int(token.text) if token.text.isdigit() else float(token.text))
        if token.kind == "text":
            return ("value", token.text[1:-1])
        if token.text in ("True", "False"):
            return ("value", token.text == "True")
        if token.text == "p" and self._is("[") and self._same_line():
            self._take()
            return ("pose", self._list("]"))
        if token.kind == "name":
            return ("name", token.text)
        if token.text == "[":
            return ("list", self._list("]"))
        if token.text == "(":
            inner = self._expression()
            self._expect(")")
            return inner
        raise ScriptError(f"line {token.line}: an expression expected, not {token.text!r}")
