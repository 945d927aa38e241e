"""Finds the commands: every function under `@command(...)` in the modules of tools/commands.

A module is imported when its command is called. Until then only the text of its decorator is read, so that `weldcal
--help` is fast.
"""

import ast
import importlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from weldcal.tools.cli.options import CliCommand

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
