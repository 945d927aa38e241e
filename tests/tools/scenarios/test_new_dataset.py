"""The example of a dataset is refused where something would be lost; `calibrate` reads what it writes."""

from pathlib import Path

import numpy as np
import pytest

from weldcal.calibration.data.dataset import load_dataset
from weldcal.models.errors import InputError
from weldcal.tools.commands.new import write_example


def test_an_example_is_not_written_over_something(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty: choose another folder"):
        write_example(tmp_path, 0)


def test_an_example_has_scans_of_a_flange_with_their_poses(tmp_path: Path) -> None:
    written = write_example(tmp_path / "mine", 1)
    dataset = load_dataset(written)
    assert len(dataset.clouds) >= 6
    assert (written / "README.md").read_text().count(str(written)) == 1
    assert all(np.isfinite(cloud).all(axis=-1).sum() > 1000 for cloud in map(dataset.cloud, dataset.clouds))
