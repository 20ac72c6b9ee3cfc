"""The fitted field as a node receives it: checked, loaded, and handed out as one immutable record."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage

from octn_ros.errors import CheckpointError, QueryError, in_words
from octn_ros.field import Field, field_hash, loads_field
from octn_ros.nodes import conversions, qos
from octn_ros.nodes.parameters import ConfigParameters
from octn_ros.settings import check_settings, setting

KINDS = ("interpolated", "neural")  # from the least on
# Scans of an OCT are between these; another unit than metres is not.
_SMALLEST_SPACING_M, _LARGEST_EXTENT_M = 1e-8, 1.0
_PROBED = 9  # points along each axis at which a new field is looked at


@dataclass(frozen=True)
class FieldRequirements:
    """Which fields a node takes."""

    least_field_kind: str = setting(
        "interpolated",
        "least that a field must be: interpolated (through the measured voxels, at once) or neural (fitted)",
        choices=KINDS,
    )
    largest_field_mb: int = setting(
        1024, "largest message of a field that is looked at; larger ones are refused", unit="MB", low=1, high=65_536
    )

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(frozen=True)
class ReceivedField:
    """A field and its identity on the wire.

    Attributes:
        field: the field, on the node's device.
        hash: identity of its bytes, 16 hex digits.
        stamp_ns: acquisition time of the scan it was fitted to.
        frame: the OCT frame's name.
    """

    field: Field
    hash: str
    stamp_ns: int
    frame: str

    def identity(self) -> dict[str, Any]:
        """Return what names the field in a status: the stamp of its scan, its content hash and its kind."""
        return {"stamp_ns": self.stamp_ns, "field_hash": self.hash, "field_kind": self.field.kind}


class FieldReceiver:
    """Subscribes to `field` and keeps the last good one; a bad message is reported and changes nothing.

    Nor does a field that is here already, which a trainer that starts again publishes: its plans still hold. A field of
    an older scan is taken, as a file may be loaded on purpose; who listens is told how much older.

    Declares the parameters of `FieldRequirements`. A kind that was refused is not kept for later: after the parameter
    was lowered, the next field counts.

    Args:
        node: the node that listens.
        device: where the field is put.
        received: called with each new field, and with the words for how much older its scan is than that of the last
            one, as a clause behind "field"; empty where it is not.
        refused: called with the reason why a message was not accepted and what is left, as a sentence, and whether
            the message was of another scan than the field that is kept, so that plans on it are out of date.
        group: callback group of the subscription; one that `plan` services share never mixes two fields.
    """

    def __init__(
        self,
        node: Node,
        device: torch.device,
        received: Callable[[ReceivedField, str], None],
        refused: Callable[[str, bool], None],
        group: CallbackGroup,
    ) -> None:
        self._device, self._received, self._refused = device, received, refused
        self._requirements = ConfigParameters(node, FieldRequirements(), read_only=("largest_field_mb",))
        self._current: ReceivedField | None = None
        node.create_subscription(CompressedImage, "field", self._on_field, qos.LATCHED, callback_group=group)

    @property
    def current(self) -> ReceivedField | None:
        """The present field, None before the first."""
        return self._current

    def required(self) -> ReceivedField:
        """Return the present field.

        Raises:
            QueryError: there is none yet, or it is less than the parameter `least_field_kind` now asks for.
        """
        received = self._current
        if received is None:
            raise QueryError("expected a fitted field, got none yet; scan or load a C-scan and wait for its fit")
        self._check_kind(received.field.kind, self._requirements.config().least_field_kind)
        return received

    def _on_field(self, message: CompressedImage) -> None:
        last = self._current
        try:
            received = self._checked(message)
            if received is not last:
                self._current = received
                older_s = (last.stamp_ns - received.stamp_ns) * 1e-9 if last else 0.0
                older = f", whose scan is {older_s:.1f} s older than that of the last field" if older_s > 0 else ""
                self._received(received, older)
        except Exception as error:  # also a fault of ours, or the device's memory is full: the node lives on
            self._current = last
            kept = "the last one is kept" if last else "there is none"
            outdated = last is not None and conversions.stamp_to_ns(message.header.stamp) != last.stamp_ns
            self._refused(f"field refused, {kept}: {in_words(error)}", outdated)

    def _checked(self, message: CompressedImage) -> ReceivedField:
        requirements = self._requirements.config()
        size, largest = len(message.data), requirements.largest_field_mb * 1_000_000
        if size > largest:
            raise CheckpointError(
                f"expected a field of at most {largest / 1e6:.0f} MB (parameter largest_field_mb), got {size / 1e6:.1f}"
            )
        data = conversions.field_data(message)
        identity, last = field_hash(data), self._current
        stamp_ns, frame = conversions.stamp_to_ns(message.header.stamp), message.header.frame_id
        if last is not None and (last.hash, last.stamp_ns, last.frame) == (identity, stamp_ns, frame):
            return last
        field = loads_field(data, self._device)
        self._check_kind(field.kind, requirements.least_field_kind)
        _check_origin(field, stamp_ns, frame)
        _check_values(field)
        return ReceivedField(field, identity, stamp_ns, frame)

    @staticmethod
    def _check_kind(kind: str, least: str) -> None:
        if KINDS.index(kind) < KINDS.index(least):
            raise QueryError(
                f"expected a field of kind {least} (parameter least_field_kind), got an {kind} one; wait for the fit"
            )


def _check_origin(field: Field, stamp_ns: int, frame: str) -> None:
    """Refuse a field that its message says is of another scan, or whose scan has no size that an OCT's has."""
    geometry, stored_ns = field.geometry, field.description.stamp_ns
    if (stored_ns, geometry.frame) != (stamp_ns, frame):
        raise CheckpointError(
            f"expected the message of a field to name its scan, {stored_ns} ns in {geometry.frame!r}, "
            f"got {stamp_ns} ns in {frame!r}"
        )
    if min(geometry.spacing_m) < _SMALLEST_SPACING_M or max(geometry.extent_m) > _LARGEST_EXTENT_M:
        raise CheckpointError(
            f"expected a scan with voxels of at least {_SMALLEST_SPACING_M * 1e6:g} um over at most "
            f"{_LARGEST_EXTENT_M:g} m, got spacings of {geometry.spacing_m} m over {geometry.extent_m} m; are they in "
            "metres?"
        )


def _check_values(field: Field) -> None:
    """Refuse a field whose parameters are finite but whose intensities are not."""
    axis = torch.linspace(-1.0, 1.0, _PROBED, device=field.device)
    values = field.lattice(axis, axis, axis)
    if not math.isfinite(float(values.sum())):
        raise CheckpointError("the field's intensities are not finite; fit it again")
