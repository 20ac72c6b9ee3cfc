"""What was freed goes back to the system."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

from octn_ros.nodes.freed_memory import give_back_freed_memory

PIECE, PIECES = 100_000, 1_000  # too small for the C library to hand each back by itself


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries cannot be told to")
def test_what_was_freed_in_pieces_goes_back() -> None:
    pieces = [b"x" * (PIECE + number % 2) for number in range(PIECES)]
    last = pieces.pop()  # keeps the library from giving back what lies before it
    held = resident_bytes()
    pieces.clear()
    give_back_freed_memory()
    assert held - resident_bytes() > 0.8 * PIECE * PIECES
    assert len(last) > 0


def test_with_nothing_to_give_back_nothing_happens() -> None:
    give_back_freed_memory()
    give_back_freed_memory()
