"""The made parts, written once and read once for all tests of this folder."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from tests.worlds.parts.step_parts import PARTS, MadePart
from weldcal.models.workpieces.reading import read_shape
from weldcal.models.workpieces.shape import PartShape


class Shelf:
    """The parts by name, each with its shape as read from STEP and the CSV of its seam."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.get = cache(self._made)

    def _made(self, name: str) -> tuple[MadePart, PartShape, Path]:
        made = PARTS[name]()
        step, csv = made.write(self.folder)
        return made, read_shape(step, "mm"), csv


@pytest.fixture(scope="session")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Shelf:
    return Shelf(tmp_path_factory.mktemp("parts"))
