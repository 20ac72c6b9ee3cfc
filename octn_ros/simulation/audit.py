"""The audit record: what was asked of the laser, by whom, and what it did, as lines of JSON that are only added to."""

from __future__ import annotations

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

    Args:
        path: the file, made with its folder when the first line is written; None keeps no record.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path

    def write(self, lines: Iterable[dict[str, Any]], *, durable: bool = False) -> None:
        """Add lines.

        Args:
            lines: what JSON can hold.
            durable: wait until they are on the disk.

        Raises:
            ExecutionError: the file cannot be written. What cannot be recorded must not be done.
        """
        if self.path is None:
            return
        text = "".join(json.dumps(line) + "\n" for line in lines)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(text)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
        except OSError as error:
            raise ExecutionError(
                f"expected an audit record that can be written at {self.path}, got {error.strerror or error}; set "
                "audit_path, or set it empty to keep none"
            ) from error
