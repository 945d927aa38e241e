"""Pose tables of 41 forms of makers are read right, or their form is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.calibration.hand_eye.makers import MAKERS, Maker, judged


@pytest.mark.parametrize("maker", MAKERS, ids=lambda maker: maker.name)
def test_a_table_of_a_maker_is_read_right(maker: Maker, tmp_path: Path) -> None:
    verdict, words = judged(maker, np.random.default_rng(MAKERS.index(maker)), tmp_path)
    assert verdict == "right", words
