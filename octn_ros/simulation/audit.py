"""The audit record: what was asked of the laser, by whom, and what it did, as lines of JSON that are only added to."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from octn_ros.errors import ExecutionError


def default_audit_path() -> Path:
    """Return where the record is kept if nobody says: $ROS_HOME/octn_ros/audit.jsonl, ~/.ros where that is not set."""
    return Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "octn_ros" / "audit.jsonl"


class AuditRecord:
    """Adds to a file of JSON lines; each is an event with its time. Not thread-safe, nor for two processes at once.

    A line is written as a whole or not at all; where a process was ended within one, the next begins on a line of its
    own.

    Args:
        path: the file, made with its folder when the first line is written; None keeps no record.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._owed = b""

    def write(self, lines: Iterable[dict[str, Any]], *, durable: bool = False, happened: bool = False) -> None:
        """Add lines.

        Args:
            lines: what JSON can hold.
            durable: wait until they are on the disk.
            happened: they tell of what cannot be left undone any more; if they cannot be written now they are written
                before the next ones.

        Raises:
            ExecutionError: the file cannot be written. What cannot be recorded must not be done.
        """
        if self.path is None:
            return
        added = b"".join(json.dumps(line).encode() + b"\n" for line in lines)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _append(self.path, self._owed + added, durable=durable)
            self._owed = b""
        except OSError as error:
            if happened:
                self._owed += added
            raise ExecutionError(
                f"expected an audit record that can be written at {self.path}, got {error.strerror or error}; set "
                "audit_path, or set it empty to keep none"
            ) from error


def _append(path: Path, data: bytes, *, durable: bool) -> None:
    """Add bytes to a file, all of them or none."""
    with path.open("a+b", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size and os.pread(file.fileno(), 1, size - 1) != b"\n":
            data = b"\n" + data
        try:
            while data:
                data = data[file.write(data) :]
            if durable:
                os.fsync(file.fileno())
        except OSError:
            with contextlib.suppress(OSError):
                file.truncate(size)
            raise
