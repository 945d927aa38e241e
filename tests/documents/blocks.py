"""The fenced blocks of README and docs: where each stands, what kind it is, and the commands in it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.places import ROOT

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Indented as in a list, or not; of any language; closed by the same fence.
FENCE = re.compile(r"^( *)(`{3,})([^\n`]*)\n(.*?)^\1\2 *$", re.MULTILINE | re.DOTALL)
SHELLS = ("sh", "bash", "shell", "console")
PROGRAMS = ("weldcal", "./tools/run")


@dataclass(frozen=True)
class Block:
    """A fenced block: its page (relative to the root), the line of its fence, its language as written, and its text."""

    page: str
    line: int
    language: str
    text: str

    @property
    def kind(self) -> str:
        """shell, python, yaml, toml, directive (of Sphinx) or text (a listing that nothing reads)."""
        if self.language.startswith("{"):
            return "directive"
        if self.language in SHELLS or any(is_command(line) for line in self.text.splitlines()):
            return "shell"
        if self.language in ("python", "yaml", "toml"):
            return self.language
        return "yaml" if re.match(r"extends: ", self.text) else "text"

    def commands(self) -> list[str]:
        """The lines of a shell block that are typed, without the prompt, a comment behind them, and what they print."""
        joined = re.sub(r" *\\\n\s*", " ", self.text)
        prompted = any(line.startswith("$ ") for line in joined.splitlines())
        typed = [line.strip() for line in joined.splitlines() if not prompted or line.startswith("$ ")]
        bare = (re.sub(r"\s+#.*$", "", line.removeprefix("$ ")) for line in typed if not line.startswith("#"))
        return [line for line in bare if line]


def is_command(line: str) -> bool:
    """Whether a line runs weldcal."""
    return line.removeprefix("$ ").split(" ")[0] in PROGRAMS


def blocks_of(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    for found in FENCE.finditer(text):
        body = "\n".join(line.removeprefix(found[1]) for line in found[4].split("\n"))
        line = text.count("\n", 0, found.start()) + 1
        yield Block(page.relative_to(ROOT).as_posix(), line, found[3].strip(), body)


def all_blocks() -> list[Block]:
    """The blocks of all pages but the directives of Sphinx, which the site's build executes."""
    return [block for page in DOCUMENTS for block in blocks_of(page) if block.kind != "directive"]
