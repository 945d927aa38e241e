"""A command has few options of its own; how a file is read is --as, and an option that it replaced names it."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.contract.test_cli import LEAVES
from tests.places import ROOT
from weldcal.tools.cli.app import app
from weldcal.tools.cli.options import COMMON, KEYS, LIVE, RESULT

MOST_OPTIONS = 12
SHARED = {*RESULT, *LIVE, "record"}
VALUES = {"robot-form": "euler_xyz,deg", "camera-form": "matrix,inverse", "intrinsics": "my camera.yaml", "set": "a"}
VALUES |= {"motions": "", "trial": "0", "side": "right", "z": "away"}
ARGUMENTS = dict.fromkeys(("profiler clock", "profiler seam"), ("--calibration", "c"))
ARGUMENTS["profiler step"] = ("--height", "10")
ARGUMENTS["camera"] = ("--board", "chessboard:9x6:25")
ARGUMENTS["verify"] = ("no_such", "--board", "chessboard:9x6:25")
KEYED = [(name.partition(" ")[2], key) for name, made in LEAVES.items() for key in getattr(made, "keys", ())]


@pytest.mark.parametrize("name", LEAVES)
def test_a_command_has_few_options_of_its_own(name: str) -> None:
    assert set(COMMON) > SHARED
    options = [one for one in LEAVES[name].params if one.param_type_name == "option"]
    own = [one.opts[0] for one in options if one.name not in SHARED]
    assert not any(one.hidden for one in options)
    assert len(own) <= MOST_OPTIONS, f"{name} has {len(own)} options of its own: {', '.join(own)}"


@pytest.mark.parametrize(("name", "key"), KEYED)
def test_an_option_that_became_a_key_says_what_to_write(
    name: str, key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words, value = [*name.split(), "no_such", *ARGUMENTS.get(name, ())], VALUES.get(key, "0.05")
    refused = CliRunner().invoke(app, [*words, f"--{key}", *filter(None, [value])])
    assert refused.exit_code == 2
    advice = re.search(r"write (--as .*)\.$", refused.stderr, re.MULTILINE)
    assert advice, refused.stderr
    followed = CliRunner().invoke(app, [*words, *shlex.split(advice[1])])
    assert followed.exit_code == 1, followed.stderr
    assert re.search("no_such|'c'|--board", followed.stderr), "the words are read; what is missing is another"


def test_every_key_is_explained_and_belongs_to_a_command() -> None:
    text = (ROOT / "docs" / "datasets.md").read_text()
    assert {key for _, key in KEYED} == set(KEYS)
    assert [key for key in KEYS if f"`{key}`" not in text] == []


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("side=up", "side is left or right, not 'up'."),
        ("trial=1.5", "trial is a whole number, not '1.5'."),
        ("pitch=inf", "inf is not a number from"),
        ("set=", "set is a name, not ''."),
        ("robot-frm=x", "there is no key 'robot-frm'; did you mean 'robot-form'? The keys of this command are robot-"),
        ("motions=yes", "there is no key 'motions'; the keys of this command are robot-form, set,"),
    ],
)
def test_a_wrong_word_is_one_sentence_with_the_keys(word: str, sentence: str) -> None:
    refused = CliRunner().invoke(app, ["profiler", "edge", "no_such", "--as", word])
    assert refused.exit_code == 2
    assert sentence in refused.stderr
