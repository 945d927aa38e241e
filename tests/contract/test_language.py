"""Hold the pages, the docstrings and the messages to plain words and short sentences."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.places import ROOT

LONGEST = 30  # words a sentence; writers aim at 25
# Their words come from the source.
WRITTEN_BY_COMMANDS = ("scenario.md", "command_line.md", "BENCHMARK.md", "weld_log_columns.md")
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.name not in WRITTEN_BY_COMMANDS),
]
FOLDERS = ("models", "calibration", "welding", "systems", "tools")
# Words of the house that an engineer of the field does not use, and in a few cases uses for something else. The name of
# an option (--seen) is no word.
FORBIDDEN = re.compile(
    r"(?<!--)\b(rooms?|halls?|house|persons?|furnishings?|seen|said|tells?|told|stands|kept|ways?|knock(?:s|ed)?"
    r"|open directions?|doubts?|remed(?:y|ies))\b",
    re.IGNORECASE,
)
# What the source still has of each; a count may only fall. Lower the number when it did.
CEILINGS = {
    "first lines that are longer than one line": 40,
    "first lines with a forbidden word": 42,
    "docstring sentences over 30 words": 194,
    "messages with a sentence over 30 words": 0,
    "messages with a forbidden word": 0,
}

FENCE = re.compile(r"^(`{3,}|~{3,})[^\n]*\n.*?^\1[ \t]*$", re.MULTILINE | re.DOTALL)
ABBREVIATION = re.compile(r"\b(e\.g|i\.e|Eq|Eqs|Fig|Figs|al|vs|No|cf|approx|Sec)\.\s")
END = re.compile(r"(?<=[.!?])[\"'”)\]*_]*\s+")


def plain(text: str) -> str:
    """Take out of Markdown what is no word: code is one word, a link its text."""
    text = re.sub(r"<!--.*?-->|<https?:[^>]*>", "", text, flags=re.DOTALL)
    text = re.sub(r"(`+)(.+?)\1", "CODE", text, flags=re.DOTALL)
    text = re.sub(r"!?\[((?:[^\[\]]|\[[^\]]*\])*)\]\([^)]*\)", r"\1", text, flags=re.DOTALL)
    return text.replace("**", "").replace("☐", "")


def sentences(text: str) -> list[str]:
    """Split running text at its full stops, question marks and exclamation marks."""
    text = ABBREVIATION.sub(lambda found: found[0].replace(". ", ".\u00a0"), " ".join(text.split()))
    return [part.strip() for part in END.split(text) if part.strip()]


def length(sentence: str) -> int:
    """Count the words of a sentence: numbers and code count, signs do not."""
    return sum(any(letter.isalnum() for letter in word) for word in sentence.split(" "))


def passages(markdown: str) -> Iterator[str]:
    """Yield each paragraph, list item, heading and table cell of a page, without code and formulas."""
    text = re.sub(r"\A---\n.*?^---\n", "", markdown, flags=re.MULTILINE | re.DOTALL)
    text = plain(FENCE.sub("\n", text))
    lines: list[str] = []
    for line in (*text.splitlines(), ""):
        alone = re.match(r"\s*(#+ |\|)", line)
        if alone or not line.strip() or re.match(r"\s*([-*+]|\d+\.) ", line):
            yield " ".join(lines)
            lines = []
        if line.lstrip().startswith("|"):
            yield from (cell for cell in line.strip().strip("|").split(" | ") if re.search(r"\w", cell))
        elif re.match(r"\s*#+ ", line):
            yield line.lstrip("# ")
        elif lines or not line.startswith("    "):
            lines += [re.sub(r"^\s*([-*+]|\d+\.) ", "", line)] if line.strip() else []


def faults(text: str) -> list[str]:
    """Name the sentences of a text that are too long, and its forbidden words."""
    long = [f"{length(part)} words: {part}" for part in sentences(text) if length(part) > LONGEST]
    words = FORBIDDEN.findall(re.sub(r'"[^"]*"', "", text))  # a page may quote a message of the program
    return long + [f"'{word}' in: {text[:90]}" for word in words]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_has_short_sentences_of_plain_words(page: Path) -> None:
    assert [fault for text in passages(page.read_text(encoding="utf-8")) for fault in faults(text)] == []


def test_a_long_sentence_and_a_forbidden_word_are_found() -> None:
    long = "The guard " + "and the arm " * 10 + "stop."
    found = [len(faults(text)) for text in passages(f"# A page\n\nShort.\n{long}\n\n| a | as he told us |\n")]
    assert sum(found) == 2


def test_code_formulas_and_links_are_no_words() -> None:
    page = "`the way` [text](way.md)\n\n    said = told + kept\n\n```sh\nweldcal seen\n```\n"
    assert [fault for text in passages(page) for fault in faults(text)] == []


def test_a_list_of_short_items_is_no_long_sentence() -> None:
    assert [fault for text in passages("- one item of a list\n" * 20) for fault in faults(text)] == []


@cache
def trees() -> tuple[ast.Module, ...]:
    return tuple(
        ast.parse(path.read_text(encoding="utf-8")) for name in FOLDERS for path in sorted((ROOT / name).rglob("*.py"))
    )


def docstrings() -> Iterator[str]:
    for tree in trees():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                yield ast.get_docstring(node) or ""


def messages() -> Iterator[str]:
    """Yield the text of each exception that the source raises; a value in it counts as one word."""
    for tree in trees():
        for raised in (node for node in ast.walk(tree) if isinstance(node, ast.Raise) and node.exc is not None):
            assert raised.exc is not None
            for text in ast.walk(raised.exc):
                if isinstance(text, ast.JoinedStr):
                    yield "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in text.values)
                elif isinstance(text, ast.Constant) and isinstance(text.value, str) and " " in text.value:
                    yield text.value


def too_long(text: str) -> int:
    return sum(length(sentence) > LONGEST for sentence in sentences(text))


def counts() -> dict[str, int]:
    """Count in the source what `CEILINGS` limits."""
    heads = [text.partition("\n\n")[0] for text in docstrings()]
    raised = list(messages())
    running = [passage for text in docstrings() for passage in passages(text.partition("\n\nArgs:")[0])]
    figures = (
        sum("\n" in head for head in heads),
        sum(bool(FORBIDDEN.search(plain(head))) for head in heads),
        sum(too_long(text) for text in running),
        sum(bool(too_long(text)) for text in raised),
        sum(bool(FORBIDDEN.search(text)) for text in raised),
    )
    return dict(zip(CEILINGS, figures, strict=True))


def test_the_source_has_no_more_faults_of_language_than_before() -> None:
    found = counts()
    assert {name: n for name, n in found.items() if n > CEILINGS[name]} == {}, f"found {found}"
