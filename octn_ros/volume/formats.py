"""Which format a file's name tells, and the module of this room that reads or writes it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def format_suffix(path: Path) -> str:
    """Return the suffix that tells a file's format, in lower case: the last one, or both of .nii.gz."""
    name = path.name.lower()
    return ".nii.gz" if name.endswith(".nii.gz") else Path(name).suffix


def format_function(name: str) -> Callable[..., Any]:
    """Return the function of a reader or writer, "module.function" of this room, loading its module only now."""
    module, function = name.split(".")
    return getattr(importlib.import_module(f"octn_ros.volume.{module}"), function)
