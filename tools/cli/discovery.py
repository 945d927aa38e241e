"""Finds the commands: every function under `@command(...)` in the modules of tools/commands.

A module is imported when its command is called. Until then only the text of its decorator is read, so that `weldcal
--help` is fast; for the help of the command, and to refuse a path that is not there, what its signature needs is run.
"""

import ast
import functools
import importlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from typer.models import ArgumentInfo

from weldcal.models.errors import InputError
from weldcal.tools import console
from weldcal.tools.cli.options import CliCommand, check_writable

PACKAGES = ("weldcal.tools.commands", "weldcal.tools.cli")
"""Packages whose modules, at any depth, hold the commands of weldcal."""

DECORATOR = re.compile(r"^@command(\([^@]*?\))\n(?:@one_of\([^@]*?\)\n)?def ", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Entry:
    """A command that is not imported yet: its full name, its line in the list of commands and its module."""

    title: str
    short_help: str
    module: str

    def load(self) -> CliCommand:
        """Return the command; imports its module."""
        for value in vars(importlib.import_module(self.module)).values():
            if isinstance(value, CliCommand) and value.title == self.title:
                return value
        raise LookupError(f"{self.module} does not hold the command '{self.title}' under a name of its own.")

    def head(self) -> CliCommand:
        """Return the command with its signature and help. A call of it imports the module."""
        tree = _read(self.module)
        command = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and _title(node) == self.title)
        command.body = command.body[:1]  # the help
        found: CliCommand = _made(self.module, tree, {command.name})[command.name]

        def call(**given: Any) -> None:
            found.read(given)
            with console.boundary(json_wanted=given.get("json", False), debug=given["debug"]):
                if given.get("out") is not None:
                    check_writable(given["out"])
                _check_paths(found, given)
                whole = self.load()
            whole.function(**given)

        return replace(found, function=functools.wraps(found.function)(call))


def _origin(module: str) -> str:
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    return spec.origin


def _read(module: str) -> ast.Module:
    return ast.parse(Path(_origin(module)).read_text(encoding="utf-8"))


def _made(module: str, tree: ast.Module, names: set[str]) -> dict[str, Any]:
    """Run the statements of a module that these names need, in it and in the modules of weldcal that they come from.

    A class is never made twice: the module that holds it is imported.
    """
    kept: set[ast.stmt] = set()
    used = names | {"annotations"}  # as it is imported from __future__
    while more := {node for node in tree.body if used.intersection(_bound(node))} - kept:
        kept |= more
        used |= {node.id for one in more for node in ast.walk(one) if isinstance(node, ast.Name)}
    if any(isinstance(node, ast.ClassDef) for node in kept):
        return vars(importlib.import_module(module))
    scope: dict[str, Any] = {"__name__": module, "__file__": _origin(module)}
    for node in (one for one in tree.body if one in kept):
        source = str(node.module) if isinstance(node, ast.ImportFrom) else ""
        if source.startswith("weldcal.") and source not in sys.modules:
            wanted = {name: alias for name, alias in _bound(node).items() if name in used}
            there = _made(source, _read(source), set(wanted.values()))
            scope |= {name: there[alias] for name, alias in wanted.items()}
        else:
            exec(compile(ast.Module([node], []), scope["__file__"], "exec"), scope)
    return scope


def _title(function: ast.FunctionDef) -> str:
    """Return the title that a function has by its decorator; empty for one that is no command."""
    calls = (one for one in function.decorator_list if isinstance(one, ast.Call) and one.args)
    return next((ast.literal_eval(one.args[0]) for one in calls if ast.unparse(one.func) == "command"), "")


def _bound(statement: ast.stmt) -> dict[str, str]:
    """Return the names that a statement makes, each with its name in the module that it is imported from."""
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return {alias.asname or alias.name.partition(".")[0]: alias.name for alias in statement.names}
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return {statement.name: statement.name}
    stored = (node for node in ast.walk(statement) if isinstance(node, ast.Name))
    return {node.id: node.id for node in stored if isinstance(node.ctx, ast.Store)}


def _check_paths(command: CliCommand, given: Mapping[str, Any]) -> None:
    """Refuse a path that is not there before the imports. An argument that is written has `writable`.

    A scenario in place of an argument is wrong usage, which the command says.

    Raises:
        InputError: it names the path, and says what the argument is.
    """
    if given.get("scenario") is not None:
        return
    for name, parameter in inspect.signature(command.function).parameters.items():
        info = next(iter(getattr(parameter.annotation, "__metadata__", ())), None)
        if isinstance(info, ArgumentInfo) and not info.writable:
            for path in given[name] if isinstance(given[name], list | tuple) else [given[name]]:
                if isinstance(path, Path) and not path.exists():
                    raise InputError(f"There is no file or folder '{path}'. Give here: {info.help}")


def find_commands(packages: Sequence[str] = PACKAGES) -> dict[str, Entry]:
    """Read all commands of packages by title, without importing their modules.

    Raises:
        ValueError: two functions are the same command.
    """
    found: dict[str, Entry] = {}
    for package in packages:
        for folder in map(Path, importlib.import_module(package).__path__):
            for path in sorted(folder.rglob("*.py")):
                module = ".".join((package, *path.relative_to(folder).with_suffix("").parts))
                for entry in _entries(path.read_text(encoding="utf-8"), module):
                    if entry.title in found:
                        raise ValueError(f"'{entry.title}' is in {found[entry.title].module} and in {module}.")
                    found[entry.title] = entry
    return found


def _entries(text: str, module: str) -> Iterator[Entry]:
    for decorator in DECORATOR.finditer(text):
        call = ast.parse(f"command{decorator[1]}", mode="eval").body
        assert isinstance(call, ast.Call)
        given = {word.arg: word.value for word in call.keywords}
        yield Entry(ast.literal_eval(call.args[0]), ast.literal_eval(given["short_help"]), module)
