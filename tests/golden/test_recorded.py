"""What needs no live run gives the kept figures."""

from __future__ import annotations

import pytest

from tests.golden.calls import CASES, RECORDED
from tests.golden.compare import differences
from tests.golden.run import Runs, held
from tests.places import SHARED_DATA, needs

pytestmark = [needs(SHARED_DATA), needs(CASES)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """Each call is run once."""
    return Runs(tmp_path_factory.mktemp("golden"))


@pytest.mark.parametrize("name", RECORDED)
def test_a_recorded_call_gives_its_kept_figures(name: str, runs: Runs) -> None:
    found = runs.differences(name)
    assert not found, "\n".join([f"{name}: {len(found)} figures differ; `python -m tests.golden {name}`", *found[:20]])


def test_a_change_of_a_figure_is_a_difference() -> None:
    kept = held("calibrate_aubo")
    number = next(key for key, value in kept.items() if isinstance(value, float) and value)
    for changed in ({**kept, number: kept[number] * (1.0 + 3e-6)}, {**kept, "more": 1}, {"exit_code": 0}):  # type: ignore[operator]
        assert differences("calibrate_aubo", kept, changed)
