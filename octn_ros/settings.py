"""Settings: fields of frozen configuration dataclasses that know their description, unit and range.

ROS parameters and command-line help are made from the same metadata, so nothing is typed twice.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Any, TypeVar

from octn_ros.errors import ConfigurationError

T = TypeVar("T")

SMALLEST_SPACING_UM = 0.1  # finer than any OCT system resolves; what is below has been given in millimetres


def setting(
    default: Any,
    description: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare one field of a configuration dataclass.

    Args:
        default: the value used when nothing is given; bool, int, float, str or a tuple of these.
        description: one line for a person, shown by `ros2 param describe` and `--help`.
        unit: SI unit of the value, empty for a pure number.
        low: smallest allowed value, inclusive.
        high: largest allowed value, inclusive.
        choices: the allowed strings, if only some are.
    """
    metadata = {"description": description, "unit": unit, "low": low, "high": high, "choices": choices}
    return dataclasses.field(default=default, metadata=metadata)


def check_settings(config: Any) -> None:
    """Check every field of a configuration against its declared type, range and choices.

    Call it from `__post_init__`, so that a configuration that exists is a valid one.

    Raises:
        ConfigurationError: names the field, what is allowed and what was given.
    """
    hints = typing.get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        name = f"{type(config).__name__}.{field.name}"
        if dataclasses.is_dataclass(value):
            continue
        _check_type(name, value, hints[field.name])
        for item in value if isinstance(value, tuple) else (value,):
            _check_value(name, item, field.metadata)


def check_micrometres(name: str, spacing_um: tuple[float, ...]) -> None:
    """Check that voxel spacings are micrometres and not millimetres; 0, not stated, is passed over.

    Raises:
        ConfigurationError: one is too small.
    """
    for given in spacing_um:
        if 0.0 < given < SMALLEST_SPACING_UM:
            raise ConfigurationError(
                f"{name}: expected micrometres, {SMALLEST_SPACING_UM:g} or more, got {given:g}; millimetres are "
                "multiplied by 1000"
            )


def as_plain(config: Any) -> dict[str, Any]:
    """Return a configuration as nested dicts and lists that JSON can hold."""
    return {
        key: list(value) if isinstance(value, tuple) else value for key, value in dataclasses.asdict(config).items()
    }


def from_plain(kind: type[T], values: dict[str, Any]) -> T:
    """Rebuild a configuration from `as_plain`'s output.

    Raises:
        ConfigurationError: a key is unknown, or a value is not allowed.
    """
    hints = typing.get_type_hints(kind)
    known = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(values) - known)
    if unknown:
        raise ConfigurationError(f"{kind.__name__}: expected the settings {sorted(known)}, got unknown {unknown}")
    arguments = {}
    for key, value in values.items():
        if dataclasses.is_dataclass(hints[key]) and isinstance(value, dict):
            value = from_plain(typing.cast(type, hints[key]), value)
        arguments[key] = tuple(value) if isinstance(value, list) else value
    return kind(**arguments)


def with_setting(config: T, name: str, value: Any) -> T:
    """Return a configuration with one setting changed, named by its path such as `field.grid.levels`.

    Raises:
        ConfigurationError: there is no such setting, or the value is not allowed.
    """
    first, _, rest = name.partition(".")
    known = [field.name for field in dataclasses.fields(config)]  # type: ignore[arg-type]
    if first not in known:
        raise ConfigurationError(
            f"{type(config).__name__}: expected one of the settings {', '.join(known)}, got {name!r}"
        )
    inner = getattr(config, first)
    if dataclasses.is_dataclass(inner) != bool(rest):
        raise ConfigurationError(
            f"{type(config).__name__}.{first}: expected "
            + (f"{name}.SETTING, for it holds settings of its own" if not rest else f"one value, got {name!r}")
        )
    return dataclasses.replace(config, **{first: with_setting(inner, rest, value) if rest else value})  # type: ignore[type-var]


def _check_type(name: str, value: Any, hint: Any) -> None:
    if typing.get_origin(hint) is tuple:
        items = typing.get_args(hint)
        if not isinstance(value, tuple) or (Ellipsis not in items and len(value) != len(items)):
            raise ConfigurationError(f"{name}: expected a tuple like {hint}, got {value!r}")
        for item in value:
            _check_type(name, item, items[0])
        return
    if hint is float:
        right = isinstance(value, (int, float)) and not isinstance(value, bool)
    elif hint is int:
        right = isinstance(value, int) and not isinstance(value, bool)
    elif hint in (bool, str):
        right = isinstance(value, hint)
    else:
        right = True  # types without a range of their own, such as other configurations
    if not right:
        raise ConfigurationError(f"{name}: expected {getattr(hint, '__name__', hint)}, got {value!r}")


def _check_value(name: str, value: Any, metadata: typing.Mapping[str, Any]) -> None:
    choices, low, high = metadata.get("choices"), metadata.get("low"), metadata.get("high")
    unit = f" {metadata['unit']}" if metadata.get("unit") else ""
    if choices and value not in choices:
        raise ConfigurationError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
    if isinstance(value, float) and not math.isfinite(value):
        raise ConfigurationError(f"{name}: expected a finite number{unit}, got {value}")
    if low is not None and value < low:
        raise ConfigurationError(f"{name}: expected at least {low}{unit}, got {value}{unit}")
    if high is not None and value > high:
        raise ConfigurationError(f"{name}: expected at most {high}{unit}, got {value}{unit}")
