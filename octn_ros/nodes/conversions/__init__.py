"""Messages to arrays and back: the only place where the two meet.

Every function is pure and thread-safe. Lengths are metres, times nanoseconds, quaternions (x, y, z, w).
"""

from octn_ros.field import FORMAT
from octn_ros.nodes.conversions.buffers import shortest_decimal, to_bytes_field
from octn_ros.nodes.conversions.clouds import cloud_to_points, table, to_cloud
from octn_ros.nodes.conversions.encoded_poses import encode_path, encode_pose_array, to_path
from octn_ros.nodes.conversions.fields import encode_field, field_data, to_field_message, voxel_room, with_field_message
from octn_ros.nodes.conversions.grids import LARGEST_GRID, GridView, grid_to_view, picture_to_grid, to_grid
from octn_ros.nodes.conversions.headers import header, stamp_to_ns
from octn_ros.nodes.conversions.images import image_to_array, to_colour_image, to_image
from octn_ros.nodes.conversions.markers import dot_marker, line_marker, to_marker_array
from octn_ros.nodes.conversions.poses import (
    matrix_to_pose_stamped,
    pose_to_matrix,
    poses_to_matrices,
    to_pose_array,
)
from octn_ros.nodes.conversions.tool_paths import TOOL_PATH, cloud_to_tool_path, plan_hash, tool_path, tool_path_poses

__all__ = [
    "FORMAT",
    "LARGEST_GRID",
    "TOOL_PATH",
    "GridView",
    "cloud_to_points",
    "cloud_to_tool_path",
    "dot_marker",
    "encode_field",
    "encode_path",
    "encode_pose_array",
    "field_data",
    "grid_to_view",
    "header",
    "image_to_array",
    "line_marker",
    "matrix_to_pose_stamped",
    "picture_to_grid",
    "plan_hash",
    "pose_to_matrix",
    "poses_to_matrices",
    "shortest_decimal",
    "stamp_to_ns",
    "table",
    "to_bytes_field",
    "to_cloud",
    "to_colour_image",
    "to_field_message",
    "to_grid",
    "to_image",
    "to_marker_array",
    "to_path",
    "to_pose_array",
    "tool_path",
    "tool_path_poses",
    "voxel_room",
    "with_field_message",
]
