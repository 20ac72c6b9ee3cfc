"""On what and with what a benchmark ran: hardware, versions, commit, date."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from datetime import datetime, timezone
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

import octn_ros

_PACKAGES = ("numpy", "scipy", "torch", "scikit-image", "nibabel")
_WITHOUT_FIGURES = ("commands", "embedded", "nodes")  # no benchmark runs their code
_CPU_INFO = Path("/proc/cpuinfo")


def environment(device: str) -> dict[str, Any]:
    """Return hardware, versions, git commit and date, as JSON can hold them.

    Args:
        device: the torch device that was used; a GPU is named.
    """
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "hardware": {
            "cpu": _cpu(),
            "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
            "torch_threads": torch.get_num_threads(),
            "memory_gb": _memory_gb(),
            "gpu": torch.cuda.get_device_name(device) if device.startswith("cuda") else None,
        },
        "versions": {
            "octn_ros": octn_ros.__version__,
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.release()}",
            **{name: _version(name) for name in _PACKAGES},
        },
        "commit": git_commit(Path(octn_ros.__file__).parent),
    }


def git_commit(folder: Path) -> str | None:
    """Return the commit of the checkout around a folder, with "-dirty" where tracked files differ; None without one."""
    try:
        answer = subprocess.run(
            ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):  # no git, or one that hangs: the report then says so
        return None
    return answer.stdout.strip() or None


@lru_cache(maxsize=1)
def code_hash() -> str:
    """Return a hash of the source files that figures can depend on, changes that are in no commit included."""
    package = Path(octn_ros.__file__).parent
    content = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0] in _WITHOUT_FIGURES:
            continue
        content.update(f"{path.relative_to(package)}\0".encode())
        content.update(path.read_bytes())
    return content.hexdigest()


def _cpu() -> str:
    if _CPU_INFO.is_file():
        for line in _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (ValueError, OSError, AttributeError):  # not told on this system
        return None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
