"""What may stand in a field of a message: its default and the check of what is assigned."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence, Set
from typing import Any, NamedTuple, NoReturn

import numpy as np

from octn_ros.embedded.cdr import TYPECODES
from octn_ros.embedded.definitions import ARRAY, BASE, DEFAULTS, NAME

PYTHON_TYPES = {"bool": bool, "byte": bytes, "string": str, "float32": float, "float64": float}
ZERO = {bool: False, bytes: b"\0", str: "", float: 0.0, int: 0}


class Field(NamedTuple):
    """One field: default, value -> value to keep (or error), and a type whose values are all kept as they are."""

    default: Callable[[], Any]
    convert: Callable[[Any], Any]
    kept: type | None = None


def make_field(owner: str, name: str, kind: int, argument: Any, classes: Callable[[str], type]) -> Field:
    """Return field `name` of message type `owner`; `classes` gives the class of a message type by name.

    `convert` raises AssertionError, as rclpy with checks on, for a value that is not of the field's type. It is
    stricter than Jazzy's default, which accepts such a value and fails in C when it is sent.
    """

    def refuse(value: Any, wanted: str) -> NoReturn:
        raise AssertionError(
            f"The '{name}' field of {owner} must be {wanted}, got {value!r:.60} ({type(value).__name__})"
        )

    if kind == NAME:
        cls = classes(argument)
        return Field(cls, lambda v: v if isinstance(v, cls) else refuse(v, f"of type '{cls.__name__}'"), cls)
    if kind == BASE:
        return _scalar(owner, name, argument, refuse)
    (item_kind, item_argument), size = argument
    item = make_field(owner, name, item_kind, item_argument, classes)
    base = item_argument[0] if item_kind == BASE and item_argument[0] in TYPECODES else None
    fixed = kind == ARRAY
    if base is not None and fixed:
        return Field(lambda: np.zeros(size, base), lambda v: _fixed(v, np.dtype(base), size, refuse))
    if base is not None:
        return Field(lambda: array(TYPECODES[base]), lambda v: _primitives(v, base, refuse))

    def checked(value: Any) -> Any:
        items = isinstance(value, (Sequence, Set)) and not isinstance(value, (str, bytes))
        if not items or (fixed and len(value) != size) or (size and len(value) > size):
            refuse(value, f"a sequence of {'' if fixed else 'at most '}{size} items" if size else "a sequence")
        for x in value:
            item.convert(x)
        return value

    return Field(lambda: [item.default() for _ in range(size if fixed else 0)], checked)


def _scalar(owner: str, name: str, argument: tuple[str, int], refuse: Callable[[Any, str], NoReturn]) -> Field:
    base, bound = argument
    python: Any = PYTHON_TYPES.get(base, int)
    is_number = python in (int, float)
    limits: Any = (np.iinfo if python is int else np.finfo)(base) if is_number else None
    low, high = (python(limits.min), python(limits.max)) if is_number else (0, 0)

    def convert(value: Any) -> Any:
        if not isinstance(value, python):
            refuse(value, f"of type '{python.__name__}'")
        if python is str:
            if bound and len(value) > bound:
                refuse(value, f"a string of at most {bound} characters")
        elif python is bytes:
            if len(value) != 1:
                refuse(value, "one byte")
        elif is_number and (value < low or value > high) and abs(value) != np.inf:
            refuse(value, f"in [{low}, {high}]")
        return value

    default = DEFAULTS.get((owner, name), ZERO[python])
    if base == "float64":  # every float is in range; poses are made of these
        return Field(lambda: default, lambda v: v if isinstance(v, float) else refuse(v, "of type 'float'"), float)
    return Field(lambda: default, convert)


def _fixed(value: Any, dtype: np.dtype[Any], size: int, refuse: Callable[[Any, str], NoReturn]) -> Any:
    """Return what rclpy accepts for a fixed number of numbers as a NumPy array."""
    if isinstance(value, np.ndarray) and value.dtype != dtype:
        refuse(value, f"of dtype {dtype}, not {value.dtype}")
    kept = np.asarray(value, dtype=dtype)
    if kept.shape != (size,):
        refuse(value, f"of shape ({size},), not {kept.shape}")
    return kept


def _primitives(value: Any, base: str, refuse: Callable[[Any, str], NoReturn]) -> array:
    """Return what rclpy accepts for a sequence of numbers as array.array; buffers pass without a Python loop."""
    code = TYPECODES[base]
    if isinstance(value, array) and value.typecode == code:
        return value
    out = array(code)
    if isinstance(value, np.ndarray):
        if value.dtype != np.dtype(base) or value.ndim != 1:
            refuse(value, f"1-D of dtype {base}, not {value.ndim}-D of {value.dtype}")
        out.frombytes(np.ascontiguousarray(value).view(np.uint8).data)
        return out
    if isinstance(value, (bytes, bytearray, memoryview)):
        if base != "uint8" or memoryview(value).format != "B":
            refuse(value, f"a sequence of {base}")
        out.frombytes(value)
        return out
    if isinstance(value, str) or not isinstance(value, (Sequence, Set)):
        refuse(value, f"a sequence of {base}")
    try:
        return array(code, value)
    except (TypeError, OverflowError) as error:
        refuse(value, f"a sequence of {base} ({error})")
