"""How torch's threads wait for each other; loads nothing."""

from __future__ import annotations

import os


def wait_passively() -> None:
    """Let OpenMP's threads sleep while they wait for each other, unless the environment says otherwise.

    Process-wide, and read only when torch loads, so programs call it first. Threads that spin instead are a little
    faster on an idle machine, but on two cores that are busy with other things as well, a fit step took 2.1 s with
    spinning and 0.06 s with sleeping threads.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
