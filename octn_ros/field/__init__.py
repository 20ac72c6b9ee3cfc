"""The continuous representation of a C-scan: encoding, network, and what a field answers."""

from octn_ros.field.checkpoint import FORMAT, dumps_field, field_hash, load_field, loads_field, save_field, volume_parts
from octn_ros.field.field import Field, FieldDescription
from octn_ros.field.hash_grid import HashGridConfig
from octn_ros.field.interpolated import InterpolatedField
from octn_ros.field.metric import MetricField
from octn_ros.field.network import NetworkConfig
from octn_ros.field.neural import NeuralField, NeuralFieldConfig, NeuralModel

__all__ = [
    "FORMAT",
    "Field",
    "FieldDescription",
    "HashGridConfig",
    "InterpolatedField",
    "MetricField",
    "NetworkConfig",
    "NeuralField",
    "NeuralFieldConfig",
    "NeuralModel",
    "dumps_field",
    "field_hash",
    "load_field",
    "loads_field",
    "save_field",
    "volume_parts",
]
