"""Where measured data are absent a test is skipped on an operator's computer, and fails in CI."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.places import ROOT, in_ci, require_data


@pytest.mark.parametrize("value", ["", "0", "false", "False"])
def test_without_ci_absent_data_skip(value: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CI", value)
    with pytest.raises(pytest.skip.Exception, match="measured data"):
        require_data(tmp_path / "absent")


@pytest.mark.parametrize("value", ["1", "true", "True", "yes"])
def test_in_ci_absent_data_fail(value: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CI", value)
    with pytest.raises(pytest.fail.Exception, match="in CI no test may be left out for that: absent"):
        require_data(tmp_path / "absent")
    require_data(tmp_path)


def test_the_check_before_a_merge_is_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    assert not in_ci()
    lines = (ROOT / ".ci/run").read_text().splitlines()
    (told,) = (k for k, line in enumerate(lines) if line == 'export CI="${CI:-true}"')
    assert told < lines.index("./tools/run test")


def test_no_test_skips_for_absent_data_by_itself() -> None:
    own = re.compile(r"skip(if)?\(.*(data|DATA|CAD|scans)")
    found = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in sorted((ROOT / "tests").rglob("*.py"))
        if path.name not in ("places.py", Path(__file__).name)
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if own.search(line)
    ]
    assert found == []
