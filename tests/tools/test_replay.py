"""Recordings: a run is replayed bit for bit, a change of an algorithm is named, and a file can be read wherever it was
cut off."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from typer.testing import CliRunner

from tests.systems.cells import KNOWN_CAMERA
from weldcal.models.arms.kinematics import forward_kinematics, load_arm
from weldcal.models.errors import InputError
from weldcal.systems.motion import flange_mover
from weldcal.systems.recording.reader import read_recording
from weldcal.systems.recording.writer import RecordingFailed, RecordingWriter
from weldcal.tools.cli.app import app
from weldcal.tools.commands.replay import replay_recording

# A short seam, from where the scanner is said to be, four times as fast as usual, with a tool from a file.
SHORT = f"""
extends: straight_groove
finger_camera: !RenderedFingerCamera {{hidden_from_s: 4.0}}
scanner: !RenderedScanner {{width: 412, height: 308, mounting_translation_mm: 0.0, mounting_rotation_deg: 0.0}}
job: {{calibrate: false, {KNOWN_CAMERA}}}
welding: {{speed_mm_s: 32.0, seam_length_mm: 30.0}}
tool: {{file: my_tool.yaml}}
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """The result folder of `weldcal weld --record`, in which the tag is hidden after a while, and its JSON object."""
    cell = tmp_path_factory.mktemp("cell")
    (cell / "mine.yaml").write_text(SHORT)
    shutil.copy(Path(flange_mover.__file__).parents[2] / "models" / "tools" / "welding.yaml", cell / "my_tool.yaml")
    words = ["weld", "--scenario", str(cell / "mine.yaml"), "--record", "--json", "--no-browser"]
    finished = CliRunner().invoke(app, [*words, "--out", str(cell / "out")])
    assert finished.exit_code == 1  # the job is held
    shutil.rmtree(cell / "out" / "plots", ignore_errors=True)
    (cell / "my_tool.yaml").unlink()  # the recording holds what it needs
    return cell / "out", json.loads(finished.stdout.splitlines()[-1])


def run_replay(path: Path) -> tuple[int, dict[str, object], str]:
    finished = CliRunner().invoke(app, ["replay", str(path), "--json"])
    return finished.exit_code, json.loads(finished.stdout.splitlines()[-1]), finished.stderr


def test_a_replay_is_identical(recorded: tuple[Path, dict[str, object]]) -> None:
    folder, summary = recorded
    code, found, _ = run_replay(folder)
    assert (code, found["state"]) == (0, "identical"), found
    assert found["phase"] == "held"
    assert found["cut_off"] is False
    assert found["seconds"] == pytest.approx(summary["simulated_seconds"], abs=0.0021)
    assert int(str(found["compared"])) > 3000


def test_an_algorithm_that_has_changed_is_named(
    recorded: tuple[Path, dict[str, object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flange_mover, "FEEDBACK_PER_S", flange_mover.FEEDBACK_PER_S * 1.001)
    code, found, said = run_replay(recorded[0] / "recording.mcap")
    assert (code, found["state"]) == (1, "differs")
    first = found["first"]
    assert isinstance(first, dict)
    assert str(first["name"]).startswith("arm.velocity_command[")
    assert first["was"] != first["now"]
    assert first["was"] == pytest.approx(first["now"], abs=1e-4)
    assert 0.0 < first["time_s"] < 0.2  # the first motion
    assert f"since {first['time_s']:.3f} s" in said


def test_what_was_seen_decides_and_not_the_simulation(recorded: tuple[Path, dict[str, object]]) -> None:
    """The same scan is in the file as the scanner gave it, and joints and transforms agree."""
    recording = read_recording(recorded[0] / "recording.mcap")
    scans = [scan for scan in recording.entered["scanner.scan"].values if scan.sequence]
    assert len(scans) == 1
    assert scans[0].points_C.shape == (308, 412, 3)
    assert scans[0].points_C.dtype == np.float32
    images = [image for image in recording.entered["finger_camera.image"].values if image.sequence]
    assert len({image.sequence for image in images}) == len(images) > 100
    assert not any(name.startswith("cheat") for name in recording.entered)


def test_the_file_opens_in_a_viewer_of_mcap(recorded: tuple[Path, dict[str, object]]) -> None:
    with (recorded[0] / "recording.mcap").open("rb") as file:
        reader = make_reader(file)
        messages = list(reader.iter_messages())
        times = [message.log_time for _, _, message in messages]
        assert times == sorted(times)
        topics = {channel.topic: schema.name for schema, channel, _ in messages if schema is not None}
        assert topics["/scanner/points"] == "sensor_msgs/msg/PointCloud2"
        assert topics["/finger_camera/image"] == "sensor_msgs/msg/Image"
        assert topics["/tf"] == "foxglove.FrameTransform"
        assert {a.name for a in reader.iter_attachments()} == {"scenario.yaml", "my_tool.yaml"}
        joints = {json.loads(m.data)["time"]: json.loads(m.data) for _, c, m in messages if c.topic == "/vectors"}
        moved = [json.loads(m.data) for _, c, m in messages if c.topic == "/tf"][-1]
    q = joints[max(t for t in joints)]["entered"]["arm.position_measured"]
    p = forward_kinematics(load_arm("ur10e"), np.array(q)).translation()
    assert [moved["translation"][k] for k in "xyz"] == pytest.approx(list(p), abs=1e-3)


def test_a_file_is_readable_to_its_last_whole_message_wherever_it_was_cut_off(
    recorded: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    whole = (recorded[0] / "recording.mcap").read_bytes()
    ends, begun = [], 0
    with (recorded[0] / "recording.mcap").open("rb") as file:
        for record in StreamReader(file, record_size_limit=None).records:
            if isinstance(record, Message):
                ends.append(file.tell())
            if isinstance(record, Metadata | Attachment | Channel) and not ends:
                begun = file.tell()
    cut = tmp_path / "cut.mcap"
    for at in np.random.default_rng(20).integers(begun, len(whole), 50):
        cut.write_bytes(whole[:at])
        assert read_recording(cut).n_messages == int(np.searchsorted(ends, at, side="right"))


def test_a_recording_that_was_cut_off_is_replayed_to_there(
    recorded: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    whole = (recorded[0] / "recording.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: int(0.5 * len(whole))])
    found = replay_recording(tmp_path / "cut.mcap")
    assert found.cut_off
    assert found.first is None, found.first
    assert found.seconds > 3.0


def test_what_is_no_recording_is_refused_in_a_sentence(
    recorded: tuple[Path, dict[str, object]], tmp_path: Path
) -> None:
    whole = (recorded[0] / "recording.mcap").read_bytes()
    (tmp_path / "other.mcap").write_bytes(b"no mcap at all")
    (tmp_path / "empty.mcap").write_bytes(whole[:300])
    for name in ("other.mcap", "empty.mcap"):
        with pytest.raises(
            InputError, match=r"is no recording of weldcal: give a recording\.mcap that --record has written"
        ):
            replay_recording(tmp_path / name)
    with pytest.raises(InputError, match="There is no file"):
        replay_recording(tmp_path / "nothing.mcap")


def test_a_full_disk_ends_in_a_sentence_and_the_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = load_arm("ur10e")
    sizes = {"entered": {"arm.position_measured": 6}, "left": {}}
    writer = RecordingWriter(tmp_path / "r.mcap", {}, {}, arm, sizes)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer, "_message", full)
    for tick in range(100):
        writer.changed(2 * tick, np.zeros(6), {}, {})
    with pytest.raises(RecordingFailed, match=r"is incomplete \(.*No space left on device\): free some space"):
        writer.close({})
