"""Real scans, dropped file by file into a folder, are the clouds that `calibrate` reads from their dataset."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import numpy as np

from tests.places import SHARED_DATA, needs
from tests.systems.drivers.sensors.scripted import wait_until
from weldcal.calibration.data.dataset import load_dataset
from weldcal.systems.drivers.sensors.folder_scanner import FolderScanner
from weldcal.systems.drivers.sensors.wired_scanner import acquire

AUBO = SHARED_DATA / "flange" / "aubo_i5_phoxi_s"


@needs(AUBO)
def test_the_18_aubo_scans_dropped_into_a_folder_are_those_that_calibrate_reads(tmp_path: Path) -> None:
    config = FolderScanner(folder=str(tmp_path), preset="phoxi_s", settle_s=0.02)
    scanner = acquire(config, config.source())
    scanner.start(2.0, first_frame=False)
    try:
        data = load_dataset(AUBO)
        assert len(data.clouds) == 18
        for number, (id, path) in enumerate(data.clouds.items(), 1):
            scanner.request(number)
            time.sleep(0.03)
            shutil.copyfile(path, tmp_path / f".{path.name}.tmp")
            os.replace(tmp_path / f".{path.name}.tmp", tmp_path / path.name)
            assert wait_until(lambda n=number: scanner.answer(n) is not None)
            found = scanner.answer(number)
            assert found is not None
            # the cell holds single precision, as scanners send: 5 nm from the files' digits, and nothing else changes
            assert np.array_equal(found.datum, data.cloud(id).astype(np.float32))
    finally:
        scanner.close()
    assert (scanner.counts.received, scanner.counts.garbled, scanner.counts.dropped) == (18, 0, 0)
