"""Interface definitions: messages from rosbags' Jazzy store, services from `service_texts`, plus type hashes."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

from octn_ros.embedded.requirements import check_requirements
from octn_ros.embedded.service_texts import SERVICES

check_requirements()

from rosbags.interfaces import Nodetype  # noqa: E402 - its absence is to be reported first
from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: E402

Type = tuple[int, Any]  # (BASE, (name, bound)) | (NAME, type name) | (ARRAY or SEQUENCE, (item type, size or bound))
BASE, NAME, ARRAY, SEQUENCE = (int(getattr(Nodetype, n)) for n in ("BASE", "NAME", "ARRAY", "SEQUENCE"))
FILLER = "structure_needs_at_least_one_member"  # rosidl's only field of an empty message
# rosbags drops default values; in the packages we offer only these are not zero.
DEFAULTS = {("geometry_msgs/msg/Quaternion", "w"): 1.0, ("sensor_msgs/msg/NavSatStatus", "status"): -2}

_store = get_typestore(Stores.ROS2_JAZZY)
_table: dict[str, Any] = dict(_store.fielddefs)  # (constants, fields) by type name
_store.fielddefs = _table  # what hashes are computed from
_services: list[str] = []


def _normal(kind: int, argument: Any) -> Type:
    """Return a type with `char` as IDL has it, uint8; rosbags hashes it as a type of its own."""
    if kind == BASE:
        return BASE, ("uint8" if argument[0] == "char" else argument[0], argument[1])
    if kind == NAME:
        return NAME, argument
    return int(kind), (_normal(*argument[0]), argument[1])


def _add_message(name: str, text: str) -> None:
    # The parser inserts /msg/ into every name, so a part of a service is parsed as a message and stored anew.
    parsed = name.replace("/srv/", "/msg/")
    constants, given = get_types_from_msg(text, parsed)[parsed]
    _table[name] = (constants, [(n, _normal(*t)) for n, t in given] or [(FILLER, (BASE, ("uint8", 0)))])


def add_service(name: str, text: str) -> None:
    """Register the service `name`, e.g. ``std_srvs/srv/Trigger``, from the text of its .srv file."""
    request, response = re.split(r"^---$", text, maxsplit=1, flags=re.MULTILINE)
    _add_message(f"{name}_Request", request)
    _add_message(f"{name}_Response", response)
    parts = [(part, (NAME, f"{name}_{part.title()}")) for part in ("request", "response", "event")]
    _table[f"{name}_Event"] = (
        [],
        [("info", (NAME, "service_msgs/msg/ServiceEventInfo")), *((n, (SEQUENCE, (t, 1))) for n, t in parts[:2])],
    )
    _table[name] = ([], [(f"{n}_message", t) for n, t in parts])
    _services.append(name)


for _name, (_constants, _fields) in list(_table.items()):
    _table[_name] = (_constants, [(n, _normal(*t)) for n, t in _fields])
for _name, _text in re.findall(r"^(\S+):((?:.|\n )*)", SERVICES, re.MULTILINE):
    add_service(_name, " ".join(_text.split()).replace("; ", "\n").replace("---", "\n---\n"))


def constants(name: str) -> dict[str, Any]:
    """Return the constants of a message type by name."""
    return {n: bytes([v]) if t == "byte" else v for n, t, v in _table[name][0]}


def fields(name: str) -> list[tuple[str, Type]]:
    """Return names and types of the fields of a message type, in order.

    Raises:
        KeyError: there is no such type.
    """
    return list(_table[name][1])


def names(package: str, kind: str) -> list[str]:
    """Return the short names of a package's messages (`kind` msg) or services (`kind` srv)."""
    head = f"{package}/{kind}/"
    return sorted(n[len(head) :] for n in (_table if kind == "msg" else _services) if n.startswith(head))


def module_name(short: str) -> str:
    """Return the module in which rosidl puts a class: ``PointCloud2`` lies in ``_point_cloud2``."""
    for pattern in (r"(.)([A-Z][a-z]+)", r"([a-z0-9])([A-Z])"):
        short = re.sub(pattern, r"\1_\2", short)
    return f"_{short.lower()}"


def dds_name(name: str) -> str:
    """Return the name of a type as it stands on the wire, e.g. ``std_msgs::msg::dds_::String_``."""
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


@cache
def type_hash(name: str) -> str:
    """Return the RIHS01 hash that ROS 2 Jazzy computes for a message or service type."""
    return str(_store.hash_rihs01(name))
