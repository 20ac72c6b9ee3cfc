"""What was made of a scan, kept in a file, so that a run that was broken off goes on where it stood."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any

from octn_ros.evaluation.benchmark import Row
from octn_ros.evaluation.environment import code_hash
from octn_ros.evaluation.scans import ScanSource


@dataclass(frozen=True)
class ScanResult:
    """What a benchmark's work made of one scan.

    Attributes:
        rows: of its table, with plain keys and values that JSON can hold.
        pictures: PNG content by file name.
        notes: what is to be said of the scan, one sentence each.
    """

    rows: Sequence[Row]
    pictures: Mapping[str, bytes] = dataclass_field(default_factory=dict)
    notes: Sequence[str] = ()


class KeptRows:
    """The results of single scans in a folder, each found again only by the code and the settings that made it.

    Args:
        output: the report's folder, or None to keep nothing; theirs is `volumes/NAME` in it.
        name: of the benchmark.
        configuration: every setting that decides the figures, as JSON can hold it.
        device: that they are measured on.
    """

    def __init__(self, output: Path | None, name: str, configuration: Mapping[str, Any], device: str) -> None:
        self._folder = None if output is None else output / "volumes" / name
        self._common = [code_hash(), name, configuration, device]

    def read(self, source: ScanSource) -> ScanResult | None:
        """Return what was kept of a scan; None if there is nothing, or nothing that can be read."""
        if self._folder is None:
            return None
        try:
            content = json.loads(self._path(source).read_text(encoding="utf-8"))
            pictures = {name: base64.b64decode(data) for name, data in content["pictures"].items()}
            return ScanResult(content["rows"], pictures, content["notes"])
        except (OSError, ValueError, KeyError):  # it is then measured again
            return None

    def write(self, source: ScanSource, result: ScanResult) -> None:
        """Keep what was made of a scan.

        Raises:
            OSError: the file cannot be written.
        """
        if self._folder is None:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        pictures = {name: base64.b64encode(data).decode() for name, data in result.pictures.items()}
        content = {"rows": list(result.rows), "notes": list(result.notes), "pictures": pictures}
        path = self._path(source)
        unfinished = path.with_suffix(".part")
        unfinished.write_text(json.dumps(content), encoding="utf-8")
        unfinished.replace(path)

    def _path(self, source: ScanSource) -> Path:
        assert self._folder is not None
        key = json.dumps([*self._common, source.name, source.fingerprint], sort_keys=True, default=str)
        return self._folder / f"{source.file_name}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.json"
