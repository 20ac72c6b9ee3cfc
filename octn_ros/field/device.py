"""The torch device that a `device` parameter or argument names."""

from __future__ import annotations

import torch

from octn_ros.errors import ConfigurationError

DEVICE_DESCRIPTION = "where fields are kept and evaluated: auto (a GPU if there is one), cpu, cuda, cuda:1, ..."


def torch_device(name: str) -> torch.device:
    """Return the device of that name, checked to be there.

    Raises:
        ConfigurationError: torch does not know the name, or cannot use the device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        why = str(error).splitlines()[0]
        raise ConfigurationError(f"device: expected auto, cpu or a GPU that is there, got {name!r}: {why}") from error
    return device
