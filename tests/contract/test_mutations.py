"""The list of mutations fits the sources and the tests as they are."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.figures import mutate
from tests.figures.mutate import KILLED, LIST, SURVIVED, Mutation, read_mutations, run_mutations
from tests.places import ROOT
from weldcal.models.errors import InputError

MUTATIONS = read_mutations(LIST.read_text())

# Each stated uncertainty, and the test that fails where it is too small and where it is too large.
TWO_SIDED = {
    "flange: centre": "calibration/flange/test_forms.py::test_the_stated_covariance_is_that_of_the_errors",
    "flange: half a face": "calibration/flange/test_covariance.py::test_half_a_face_is_as_far_off_in_it_as_stated",
    "flange: height and normal": (
        "calibration/flange/test_covariance.py::test_a_whole_face_is_as_high_and_as_level_as_stated"
    ),
    "flange: turn by its holes": (
        "calibration/flange/test_covariance.py::test_holes_off_their_places_say_how_well_they_know_the_turn"
    ),
    "eye on base": "calibration/eye_on_base/test_solve.py::test_covariance_predicts_the_error",
    "eye on base: four and five scans": (
        "calibration/eye_on_base/test_coverage.py::test_the_region_of_few_scans_holds_the_truth_in_95_of_100"
    ),
    "eye on base: one to three scans": (
        "calibration/eye_on_base/test_coverage.py::test_whole_poses_of_usual_cells_err_as_stated"
    ),
    "hand-eye: covariance": "calibration/hand_eye/test_region.py::test_the_covariance_is_that_of_the_errors",
    "hand-eye: region": "calibration/hand_eye/test_region.py::test_half_of_the_truths_lie_in_the_region_of_half",
    "drift: pose after a move": (
        "calibration/motion/test_drift_covariance.py::test_the_pose_after_a_move_is_as_far_off_as_stated"
    ),
    "drift: move": "calibration/motion/test_drift_covariance.py::test_the_move_is_as_far_off_as_stated",
    "profiler: edge": "calibration/profiler/test_edge.py::test_its_covariance_is_what_it_scatters_by_and_the_bound",
    "profiler: sphere": "calibration/profiler/test_sphere.py::test_its_covariance_is_what_it_scatters_by",
    "tablet: camera": "calibration/tablet/test_wrist.py::test_the_covariance_is_that_of_the_errors",
    "tablet: pen": "calibration/tablet/test_models.py::test_the_covariance_tells_how_far_the_pen_is_off",
}


def test_every_text_occurs_once_and_its_replacement_is_python() -> None:
    for mutation in MUTATIONS:
        source = (ROOT / mutation.file).read_text()
        mutated = mutation.applied(source)
        assert mutated != source, mutation.reason
        ast.parse(mutated, mutation.reason)
    assert len({m.reason for m in MUTATIONS}) == len(MUTATIONS) >= 90


def test_every_test_named_exists() -> None:
    two_sided = {f"tests/{test}" for test in TWO_SIDED.values()}
    for argument in {argument for mutation in MUTATIONS for argument in mutation.tests} | two_sided:
        file, _, name = argument.partition("::")
        assert (ROOT / file).exists(), argument
        assert not name or f"def {name}(" in (ROOT / file).read_text(), argument


def test_a_text_that_is_gone_fails_with_one_sentence() -> None:
    gone = Mutation(file="calibration/errors.py", tests=("tests",), reason="gone", text="no such text", replacement="")
    with pytest.raises(InputError, match=r"'gone' occurs 0 times in calibration/errors.py: correct mutations.txt"):
        next(run_mutations([gone], 1, lambda stage, share: None))
    with pytest.raises(InputError, match="Line 2 of mutations"):
        read_mutations("calibration/errors.py: tests\nno reason")


def test_a_copy_is_changed_and_the_project_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A project of one module and one test: one mutation is noticed, the other is not, and the files stay as they
    are."""
    root = tmp_path / "weldcal"
    (root / "tests").mkdir(parents=True)
    (root / "half.py").write_text("def half(x):\n    return x / 2\n\n\nUNUSED = 1\n")
    (root / "tests" / "test_half.py").write_text(
        "import importlib.util, pathlib\n"
        "spec = importlib.util.spec_from_file_location('half', pathlib.Path(__file__).parents[1] / 'half.py')\n"
        "module = importlib.util.module_from_spec(spec)\nspec.loader.exec_module(module)\n\n\n"
        "def test_half():\n    assert module.half(4) == 2\n"
    )
    (tmp_path / "shared").mkdir()
    before = (root / "half.py").read_text()
    monkeypatch.setattr(mutate, "ROOT", root)
    text = "half.py: tests/test_half.py\n  third\n  - x / 2\n  + x / 3\n  unused\n  - UNUSED = 1\n  + UNUSED = 2\n"
    found = {m.reason: verdict for m, verdict, _ in run_mutations(read_mutations(text), 1, lambda stage, share: None)}
    assert found == {"third": KILLED, "unused": SURVIVED}
    assert (root / "half.py").read_text() == before
