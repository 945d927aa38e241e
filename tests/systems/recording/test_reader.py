"""The rows of a recording: each value is found at its tick and on its side, in this format and in the one before."""

from __future__ import annotations

import json
from base64 import b64encode
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from weldcal.models.arms.kinematics import load_arm
from weldcal.models.errors import InputError
from weldcal.systems.recording.reader import Recording, read_recording
from weldcal.systems.recording.writer import RecordingWriter

SIZES = {"entered": {"arm.position_measured": 6, "operator.hold": 1}, "left": {"arm.velocity_command": 6}}
KEYS = [0, 1, 2, 4, 6, 8, 9, 10]  # of ticks 0 to 5; odd ones are of what entered between the updates of a tick


def rows(seed: int = 1) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=7 if key % 2 else 13) for key in KEYS]


def assert_holds(found: Recording, given: list[np.ndarray]) -> None:
    entered, left = found.rows["entered"], found.rows["left"]
    assert [key for _, key, _ in entered] == KEYS
    assert [key for _, key, _ in left] == [key for key in KEYS if key % 2 == 0]
    for (_, _, row), was in zip(entered, given, strict=True):
        assert row.tobytes() == was[:7].tobytes()
    for (_, _, row), was in zip(left, [row for row in given if len(row) > 7], strict=True):
        assert row.tobytes() == was[7:].tobytes()
    track = found.entered["operator.hold"]
    assert list(track.keys) == KEYS
    assert [float(v[0]) for v in track.values] == [float(row[6]) for row in given]


def about(format_number: int) -> dict[str, str]:
    return {"sizes": json.dumps(SIZES), "format": str(format_number)}


def of_format_1(path: Path, format_number: int) -> None:
    """What weldcal wrote before: each row with its key and its side."""
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, compression=CompressionType.NONE)
        writer.start()
        writer.add_metadata("weldcal", about(format_number))
        channel = writer.register_channel("/vectors", "json", writer.register_schema("any", "jsonschema", b"{}"))
        exact = [
            [key, side, b64encode(part.tobytes()).decode()]
            for key, row in zip(KEYS, rows(), strict=True)
            for side, part in (("entered", row[:7]), ("left", row[7:]))
            if part.size
        ]
        text = {"key": KEYS[-1], "time": 0.01, "rows": exact}
        writer.add_message(channel, 0, json.dumps(text).encode(), 0)
        writer.finish()


def test_what_is_written_is_read_in_the_order_of_its_keys(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "r.mcap", about(2), {}, load_arm("ur10e"), SIZES)
    for key, row in zip(KEYS, rows(), strict=True):
        writer.changed(key, row, {}, {})
    writer.close({})
    assert_holds(read_recording(tmp_path / "r.mcap"), rows())


def test_a_recording_of_the_format_before_is_read(tmp_path: Path) -> None:
    of_format_1(tmp_path / "r.mcap", 1)
    assert_holds(read_recording(tmp_path / "r.mcap"), rows())


def test_another_format_is_refused_by_name(tmp_path: Path) -> None:
    of_format_1(tmp_path / "r.mcap", 3)
    with pytest.raises(
        InputError, match="has the format 3, and this weldcal reads 1 and 2: use the version that wrote it"
    ):
        read_recording(tmp_path / "r.mcap")
