"""Keeps the results of finished tasks in a file, one line each, so that a study that was killed goes on where it
stopped."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from weldcal.models.errors import InputError
from weldcal.tools.console import plain

Result = dict[str, Any]
NAME = "tasks.jsonl"


class Journal:
    """The finished tasks of one study in a folder.

    The first line names the study; a last line that is cut off does not count.

    Raises:
        InputError: the folder holds the tasks of another study.
    """

    def __init__(self, folder: Path, study: Mapping[str, object]) -> None:
        self._path = folder / NAME
        self._found: dict[str, Result] = {}
        head = json.dumps(plain(study), sort_keys=True, allow_nan=False)
        lines = self._path.read_bytes().split(b"\n")[:-1] if self._path.exists() else []
        if lines and lines[0].decode("utf-8", "replace") != head:
            raise InputError(
                f"'{self._path}' holds the tasks of another study or of another version of weldcal. "
                "Give another folder with --out."
            )
        for line in lines[1:]:
            entry = json.loads(line)
            self._found[_key(entry["task"], entry["arguments"])] = entry["result"]
        folder.mkdir(parents=True, exist_ok=True)
        whole = sum(len(line) + 1 for line in lines)
        self._file = self._path.open("r+b" if self._path.exists() else "w+b")
        self._file.truncate(whole)
        self._file.seek(whole)
        if not lines:
            self._write(head)

    def result(self, task: str, arguments: Mapping[str, Any]) -> Result | None:
        """The result of a task with these arguments; None where it has not been finished."""
        return self._found.get(_key(task, arguments))

    def add(self, task: str, arguments: Mapping[str, Any], result: Result) -> None:
        """Keep a task's result on the disk."""
        text = json.dumps(plain({"task": task, "arguments": arguments, "result": result}), allow_nan=False)
        self._write(text)
        self._found[_key(task, arguments)] = json.loads(text)["result"]

    def close(self) -> None:
        """Close the file; a second call has no effect."""
        self._file.close()

    def _write(self, text: str) -> None:
        self._file.write(text.encode("utf-8") + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())


def _key(task: str, arguments: Mapping[str, Any]) -> str:
    return json.dumps(plain([task, arguments]), sort_keys=True)
