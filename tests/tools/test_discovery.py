"""A command is one file: it is found, listed and run without an edit of any other file."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import typer.main
from typer.testing import CliRunner

from weldcal.tools import commands
from weldcal.tools.cli.app import GROUPS, PANELS, build_app
from weldcal.tools.cli.discovery import find_commands

MODULE = '''"""A command of a test."""

import {imported}

from weldcal.tools.cli.options import LOOK, Call, Outcome, command


@command("{title}", common=LOOK, short_help="{help}")
def greet(call: Call) -> Outcome:
    """Greet the reader."""
    return Outcome({{"state": "done", "greeting": "hello"}})
'''


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder whose modules belong to weldcal.tools.commands."""
    monkeypatch.setattr(commands, "__path__", [*commands.__path__, str(tmp_path)])
    return tmp_path


def write(path: Path, title: str, imported: str = "json") -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_text(MODULE.format(title=title, imported=imported, help=f"Greet by {title}."))


def test_a_new_command_is_one_new_file(folder: Path) -> None:
    write(folder / "greet_one.py", "greet")
    write(folder / "deep" / "greet_two.py", "salute world")
    app = build_app()
    listed = CliRunner().invoke(app, ["--help"]).stdout
    assert re.search(r"^  greet +Greet by greet\.$", listed, re.MULTILINE)
    assert listed.index("  demo ") < listed.index("  print-board ") < listed.index("  greet ")
    assert "  world  Greet by salute world." in CliRunner().invoke(app, ["salute", "--help"]).stdout
    for words in (["greet"], ["salute", "world"]):
        finished = CliRunner().invoke(app, [*words, "--json"])
        assert finished.exit_code == 0, finished.stderr
        assert json.loads(finished.stdout)["greeting"] == "hello"


def test_debug_names_the_module_of_a_failed_import(folder: Path) -> None:
    write(folder / "greet_broken.py", "greet", imported="no_such_library")
    app = build_app()
    assert "Greet by greet." in CliRunner().invoke(app, ["--help"]).stdout
    plain = CliRunner().invoke(app, ["greet"])
    assert plain.exit_code == 1
    assert plain.stderr.startswith(
        "weldcal: Internal error of weldcal: ModuleNotFoundError: No module named 'no_such_library'"
    )
    assert len(plain.stderr.splitlines()) == 1
    shown = CliRunner().invoke(app, ["greet", "--debug"])
    assert shown.exit_code == 1
    assert "greet_broken.py" in shown.stderr


def test_two_functions_of_one_title_are_refused(folder: Path) -> None:
    write(folder / "greet_one.py", "greet")
    write(folder / "greet_two.py", "greet")
    with pytest.raises(ValueError, match=r"greet_one and in .*greet_two"):
        find_commands()


def test_what_is_read_of_every_module_is_what_it_holds() -> None:
    app = typer.main.get_command(build_app())
    for title, entry in find_commands().items():
        words = title.split()
        made = app.commands[words[0]]  # type: ignore[attr-defined]
        made = made.commands[words[1]] if words[1:] else made
        assert (made.name, made.short_help) == (words[-1], entry.short_help)
        assert entry.load().title == title


@pytest.mark.parametrize("group", ["", *GROUPS])
def test_every_command_has_one_whole_line_of_help(group: str) -> None:
    text = CliRunner().invoke(build_app(), [group, "--help"] if group else ["--help"]).stdout
    blocks = re.split(r"^(?=\S)", text, flags=re.M)  # each begins with its title
    titles = ("Commands:", *(f"{title}:" for title in PANELS))
    lines = [line.strip() for b in blocks if b.startswith(titles) for line in b.splitlines()[1:] if line.strip()]
    entries = [e for e in find_commands().values() if e.title.rpartition(" ")[0] == group]
    rows = {entry.title.split()[-1]: entry.short_help for entry in entries}
    rows |= {} if group else GROUPS
    assert {line.split()[0]: " ".join(line.split()[1:]) for line in lines} == rows
    for help in rows.values():
        assert help.endswith(".")
        assert not help.endswith(("...", "Fig.", "Eq."))
