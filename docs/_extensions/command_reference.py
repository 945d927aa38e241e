"""The Sphinx directive `command-reference`: every command of weldcal with its arguments and options, from the program itself."""

import os.path
import re
from collections.abc import Iterator
from typing import Any

import typer.main
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from weldcal.tools.cli.app import app

NAMED_PAGE = re.compile(r"docs/([\w/]+)\.md")


def leaves(command: Any, name: str = "weldcal") -> Iterator[tuple[str, Any]]:
    """Every command that does something, with its full name, in the order of the help text."""
    if hasattr(command, "commands"):
        for word, child in command.commands.items():
            yield from leaves(child, f"{name} {word}")
    else:
        yield name, command


def reference(to_docs: str) -> str:
    """The reference of all commands, in Markdown.

    Args:
        to_docs: relative path from the page to the folder of the pages that the help texts name.
    """
    return "\n".join(section(name, command, to_docs) for name, command in leaves(typer.main.get_command(app)))


def section(name: str, command: Any, to_docs: str) -> str:
    """One command: usage, purpose, and a table of its arguments and options."""
    context = command.context_class(command, info_name=name)
    usage = " ".join(command.get_usage(context).removeprefix("Usage: ").split())
    records = [parameter.get_help_record(context) for parameter in command.params]
    rows = [f"| `{typed}` | {cell(help, to_docs)} |" for typed, help in filter(None, records)]
    table = ["| argument or option | meaning |", "|---|---|", *rows]
    return "\n".join([f"## {name}", "", f"    {usage}", "", cell(command.help, to_docs), "", *table, ""])


def cell(text: str, to_docs: str) -> str:
    """A help text in one line of Markdown; the pages that it names are links."""
    line = " ".join(text.split()).replace("|", "\\|").replace("<", "\\<").replace("[", "\\[")
    return NAMED_PAGE.sub(lambda found: f"[{found[1]}]({os.path.join(to_docs, found[1])}.md)", line)


class CommandReference(SphinxDirective):
    """The directive: it has no content and no options."""

    def run(self) -> list[nodes.Node]:
        """The sections of all commands."""
        to_docs = os.path.relpath(".", os.path.dirname(self.env.docname))
        return self.parse_text_to_nodes(reference(to_docs), allow_section_headings=True)


def setup(application: Sphinx) -> dict[str, bool]:
    """Registers the directive."""
    application.add_directive("command-reference", CommandReference)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
