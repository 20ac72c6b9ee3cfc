"""What may stand in a field of a message: its type in words, its default and the check of what is assigned."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence, Set
from typing import Any, NamedTuple, NoReturn

import numpy as np

from octn_ros.embedded.cdr import TYPECODES
from octn_ros.embedded.definitions import ARRAY, BASE, DEFAULTS, NAME

IDL_NAMES = {"bool": "boolean", "byte": "octet", "float32": "float", "float64": "double"}
PYTHON_TYPES = {"bool": bool, "byte": bytes, "string": str, "float32": float, "float64": float}
ZERO = {bool: False, bytes: b"\0", str: "", float: 0.0, int: 0}
FLOAT32_MAX = float(np.finfo(np.float32).max)


class Field(NamedTuple):
    """One field: type as `get_fields_and_field_types` words it, default, and value -> value to keep (or error)."""

    text: str
    default: Callable[[], Any]
    convert: Callable[[Any], Any]


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
        return Field(
            argument.replace("/msg/", "/"),
            cls,
            lambda v: v if isinstance(v, cls) else refuse(v, f"of type '{cls.__name__}'"),
        )
    if kind == BASE:
        return _scalar(owner, name, argument, refuse)
    (item_kind, item_argument), size = argument
    item = make_field(owner, name, item_kind, item_argument, classes)
    base = item_argument[0] if item_kind == BASE and item_argument[0] in TYPECODES else None
    if kind == ARRAY:
        return _array(item, base, size, refuse)
    text = f"sequence<{item.text}{f', {size}' if size else ''}>"
    if base is not None:
        return Field(text, lambda: array(TYPECODES[base]), lambda v: _primitives(v, base, refuse))

    def checked(value: Any) -> Any:
        if not isinstance(value, (Sequence, Set)) or isinstance(value, (str, bytes)) or (size and len(value) > size):
            refuse(value, f"a sequence of at most {size} items" if size else "a sequence")
        for x in value:
            item.convert(x)
        return value

    return Field(text, list, checked)


def _scalar(owner: str, name: str, argument: tuple[str, int], refuse: Callable[[Any, str], NoReturn]) -> Field:
    base, bound = argument
    python: Any = PYTHON_TYPES.get(base, int)
    low: float
    high: float
    if python is int:
        bits = int(base.lstrip("uint"))
        low, high = (0, 2**bits - 1) if base[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    elif base == "float32":
        low, high = -FLOAT32_MAX, FLOAT32_MAX
    else:
        low, high = -np.inf, np.inf

    def convert(value: Any) -> Any:
        if not isinstance(value, python):
            refuse(value, f"of type '{python.__name__}'")
        if python is str:
            if bound and len(value) > bound:
                refuse(value, f"a string of at most {bound} characters")
        elif python is bytes:
            if len(value) != 1:
                refuse(value, "one byte")
        elif (value < low or value > high) and abs(value) != np.inf:
            refuse(value, f"in [{low}, {high}]")
        return value

    default = DEFAULTS.get((owner, name), ZERO[python])
    return Field(IDL_NAMES.get(base, base) + (f"<{bound}>" if bound else ""), lambda: default, convert)


def _array(item: Field, base: str | None, size: int, refuse: Callable[[Any, str], NoReturn]) -> Field:
    text = f"{item.text}[{size}]"
    if base is None:

        def checked(value: Any) -> Any:
            if not isinstance(value, Sequence) or isinstance(value, (str, bytes)) or len(value) != size:
                refuse(value, f"a sequence of {size} items")
            for x in value:
                item.convert(x)
            return value

        return Field(text, lambda: [item.default() for _ in range(size)], checked)
    dtype = np.dtype(base)

    def converted(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.dtype != dtype:
            refuse(value, f"of dtype {dtype}, not {value.dtype}")
        kept = np.asarray(value, dtype=dtype)
        if kept.shape != (size,):
            refuse(value, f"of shape ({size},), not {kept.shape}")
        return kept

    return Field(text, lambda: np.zeros(size, dtype), converted)


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
