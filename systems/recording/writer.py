"""Writes a recording: one MCAP file that can be read to its last whole message wherever it was cut off."""

from __future__ import annotations

import json
import queue
import threading
import time
from binascii import b2a_base64
from collections.abc import Mapping
from itertools import accumulate
from math import isfinite
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from mcap.writer import CompressionType, Writer
from pydrake.math import RigidTransform

from weldcal.models.arms.kinematics import ArmModel, forward_kinematics
from weldcal.models.errors import WeldcalError
from weldcal.systems.messages import CalibrationStatus, Image, Scan
from weldcal.systems.recording.port_recorder import BEFORE, BOTH, ENTERED, LEFT, PERIOD_S, STAGES, UPDATED
from weldcal.systems.recording.values import IMAGE, POINT_CLOUD, SCHEMAS, encode, write_cloud, write_image

_Row = tuple[int, np.ndarray]  # key, values

FORMAT: Final = 2
JOINTS: Final = "arm.position_measured"
TRANSFORM_PERIOD_S = 0.05  # a choice: 20 Hz is smooth to watch; only viewers read them, and 10 Hz would halve them
ROWS_TICKS = 10  # 20 ms between messages of rows; each has the values of all its ticks, and by name those of the newest
LISTED = 500  # numbers of an array of a result; of a larger one the digest is kept
MAY_WAIT = 200_000  # messages that wait for the disk; more are a disk that cannot keep up
BUFFER = 1 << 20  # bytes: each write gives the interpreter away and waits for it again
REST_S = 0.05  # between two turns of the writing thread: each turn takes the interpreter from the Diagram
_ANY = json.dumps({"type": "object"}).encode()
_TRANSFORM = json.dumps(
    {
        "type": "object",
        "title": "foxglove.FrameTransform",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            },
            "parent_frame_id": {"type": "string"},
            "child_frame_id": {"type": "string"},
            "translation": {
                "type": "object",
                "title": "foxglove.Vector3",
                "properties": {k: {"type": "number"} for k in "xyz"},
            },
            "rotation": {
                "type": "object",
                "title": "foxglove.Quaternion",
                "properties": {k: {"type": "number"} for k in "xyzw"},
            },
        },
    }
).encode()


class RecordingFailed(WeldcalError):
    """The recording could not be written."""


class RecordingWriter:
    """A CellSink that writes to a file in a thread of its own: an update of the Diagram waits for no disk.

    `about` goes into the file's metadata, `files` are attached by name, `sizes` are those of the ports in the rows of
    each side.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        files: Mapping[str, bytes],
        arm: ArmModel,
        sizes: Mapping[str, Mapping[str, int]],
    ) -> None:
        self._path, self._arm = path, arm
        self._slices = {side: _slices(of_side) for side, of_side in sizes.items()}
        self._n_entered = sum(sizes[ENTERED].values())
        self._joints = next((a for name, a, _ in self._slices[ENTERED] if name == JOINTS), None)
        self._waiting: list[_Row] = []
        self._next_key = 0
        self._file = path.open("wb", BUFFER)
        self._start_ns = self._at_ns = time.time_ns()
        self._writer = Writer(self._file, use_chunking=False, compression=CompressionType.NONE)
        self._writer.start(profile="weldcal", library="weldcal")
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}
        self._writer.add_metadata("weldcal", {**about, "format": str(FORMAT)})
        for name, data in files.items():
            self._writer.add_attachment(self._start_ns, self._start_ns, name, "application/octet-stream", data)
        self._file.flush()
        self._next_transform_s = 0.0
        self._queue: queue.SimpleQueue[tuple[Any, ...] | None] = queue.SimpleQueue()
        self._failed: Exception | None = None
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()

    def changed(self, key: int, row: np.ndarray | None, entered: Mapping[str, Any], left: Mapping[str, Any]) -> None:
        """See PortSink."""
        if row is not None:
            self._waiting.append((key, row))
        if entered or left or key >= self._next_key:
            self._next_key = key + STAGES * ROWS_TICKS
            self._put((key, self._waiting, entered, left))
            self._waiting = []

    def answered(self, number: int, looks: int) -> None:
        """Write how often a question was looked at before its answer was there."""
        self._put((number, looks))

    def _put(self, item: tuple[Any, ...]) -> None:
        if self._failed is None and self._queue.qsize() < MAY_WAIT:
            self._queue.put(item)
        elif self._failed is None:
            self._failed = OSError("the disk is too slow")

    def close(self, end: Mapping[str, Any]) -> None:
        """Write what waits and the end of the run. A second call has no effect.

        Raises:
            RecordingFailed: the disk is full or too slow; the file can be read up to there.
        """
        if self._file.closed:
            return
        if self._waiting:
            self._put((self._waiting[-1][0], self._waiting, {}, {}))
        self._queue.put(None)
        self._thread.join()
        try:
            if self._failed is None:
                self._message("/end", self._start_ns, json.dumps(encode(dict(end))).encode())
                self._writer.finish()  # type: ignore[no-untyped-call]
        except OSError as error:
            self._failed = error
        finally:
            try:
                self._file.close()
            except OSError as error:
                self._failed = self._failed or error
        if self._failed is not None:
            raise RecordingFailed(
                f"The recording '{self._path}' is incomplete ({self._failed}): free some space on the disk and record"
                " again."
            ) from self._failed

    def _work(self) -> None:
        try:
            while (item := self._queue.get()) is not None:
                if len(item) == 2:
                    number, looks = item
                    self._message("/answer", self._at_ns, json.dumps({"number": number, "looks": looks}).encode())
                else:
                    self._write(*item)
                if self._queue.empty():
                    self._file.flush()
                    time.sleep(REST_S)
        except Exception as error:  # what is said at the end, from the caller's thread
            self._failed = error

    def _write(self, key: int, rows: list[_Row], entered: Mapping[str, Any], left: Mapping[str, Any]) -> None:
        now = key // STAGES * PERIOD_S
        at = self._at_ns = self._start_ns + round(now * 1e9)
        if rows:
            # the newest values by name, for plots, and every bit of all of them
            whole, entered_only = ([r for r in rows if r[0] % STAGES == stage] for stage in (BEFORE, UPDATED))
            n = self._n_entered
            newest = {ENTERED: rows[-1][1][:n], LEFT: whole[-1][1][n:] if whole else rows[-1][1][n:]}
            numbers = {side: _numbers(row) for side, row in newest.items() if len(row)}
            named = {side: {name: row[a:b] for name, a, b in self._slices[side]} for side, row in numbers.items()}
            exact = [_exact(side, given) for side, given in ((BOTH, whole), (ENTERED, entered_only)) if given]
            self._message("/vectors", at, json.dumps({"key": key, "time": now, **named, "rows": exact}).encode())
            if self._joints is not None and now >= self._next_transform_s:
                self._next_transform_s = now + TRANSFORM_PERIOD_S
                q = newest[ENTERED][self._joints : self._joints + 6]
                self._transform(at, "base", "flange", forward_kinematics(self._arm, q))
        for name, value in entered.items():
            self._value("in", key, now, at, name, value)
        for name, value in left.items():
            self._value("out", key, now, at, name, value)

    def _value(self, side: str, key: int, now: float, at: int, name: str, value: Any) -> None:
        encoded = encode(value, None if side == "in" else LISTED) if not isinstance(value, Scan | Image) else None
        if isinstance(value, Scan):
            self._message("/scanner/points", at, write_cloud(value.points_C, at, "camera"), POINT_CLOUD)
            encoded = {k: encode(v) for k, v in vars(value).items() if k != "points_C"}
        elif isinstance(value, Image):
            self._message("/finger_camera/image", at, write_image(value.pixels, at, "finger_camera"), IMAGE)
            encoded = {k: encode(v) for k, v in vars(value).items() if k != "pixels"}
        text = {"key": key, "time": now, "type": type(value).__name__, "value": encoded}
        self._message(f"/{side}/{name}", at, json.dumps(text).encode())
        if isinstance(value, CalibrationStatus) and value.estimate is not None:
            self._transform(at, "base", "camera", value.estimate.X_BC)

    def _transform(self, at: int, parent: str, child: str, X: RigidTransform) -> None:
        q, p = X.rotation().ToQuaternion(), X.translation()
        text = {
            "timestamp": {"sec": at // 10**9, "nsec": at % 10**9},
            "parent_frame_id": parent,
            "child_frame_id": child,
            "translation": dict(zip("xyz", map(float, p), strict=True)),
            "rotation": {"x": q.x(), "y": q.y(), "z": q.z(), "w": q.w()},
        }
        self._message("/tf", at, json.dumps(text).encode())

    def _message(self, topic: str, at: int, data: bytes | bytearray, ros: str | None = None) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            if ros is not None:
                schema = self._writer.register_schema(ros, "ros2msg", SCHEMAS[ros].encode())
            elif topic == "/tf":
                schema = self._writer.register_schema("foxglove.FrameTransform", "jsonschema", _TRANSFORM)
            else:
                schema = self._writer.register_schema(f"weldcal{topic.replace('/', '.')}", "jsonschema", _ANY)
            channel = self._writer.register_channel(topic, "cdr" if ros else "json", schema)
            self._channels[topic] = channel
        number = self._sequence.get(topic, 0)
        self._sequence[topic] = number + 1
        self._writer.add_message(channel, at, cast("bytes", data), at, number)  # a bytearray is not copied first


def _slices(sizes: Mapping[str, int]) -> list[tuple[str, int, int]]:
    ends = list(accumulate(sizes.values()))
    return [(name, end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)]


def _exact(side: str, rows: list[_Row]) -> tuple[list[int], str, str]:
    """Keys of rows, what they hold, and every bit of them."""
    return (
        [key for key, _ in rows],
        side,
        b2a_base64(b"".join(row.data for _, row in rows), newline=False).decode("ascii"),
    )


def _numbers(row: np.ndarray) -> list[float | None]:
    """Numbers as a plot takes them."""
    return [x if isfinite(x) else None for x in row.tolist()]
