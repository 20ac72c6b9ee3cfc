"""A client made from the wire description in docs/embedded.md: Zenoh, rosbags as codec, and nothing of this package.

    foreign_client.py DOMAIN PORT RECTANGLE       (x0 y0 x1 y1 in metres in the OCT frame)

Prints one JSON object: the tokens of the graph, what the latched field says of itself, and the path that the service
plan_raster answered with.
"""

import json
import struct
import sys
import threading
import time

import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh import ext

WAIT_SEC = 120.0
STEP_SEC = 0.05
ATTACHMENT = struct.Struct("<qqB16s")
SENDER = b"foreign client !"
GET_PLAN = "nav_msgs/msg/GetPlan"  # rosbags knows messages only, and a service as its two halves

domain, port = sys.argv[1:3]
rectangle = [float(value) for value in sys.argv[3:7]]

types = get_typestore(Stores.ROS2_JAZZY)
stamped = "geometry_msgs/PoseStamped"
types.register(get_types_from_msg(f"{stamped} start\n{stamped} goal\nfloat32 tolerance\n", f"{GET_PLAN}_Request"))
types.register(get_types_from_msg("nav_msgs/Path plan\n", f"{GET_PLAN}_Response"))


def message(name, **fields):
    return types.types[name](**fields)


def corner(x, y):
    point = message("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
    straight = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    now = message("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    header = message("std_msgs/msg/Header", stamp=now, frame_id="oct_optical_frame")
    pose = message("geometry_msgs/msg/Pose", position=point, orientation=straight)
    return message("geometry_msgs/msg/PoseStamped", header=header, pose=pose)


def decode(payload, name):
    return types.deserialize_cdr(payload.to_bytes(), name)


def token(key):
    parts = [part.replace("%", "/") for part in key.split("/")]
    names = ("domain", "session", "node_number", "number", "kind", "enclave", "namespace", "node")
    return {
        **dict(zip(names, parts[1:], strict=False)),
        **dict(zip(("name", "type", "hash", "qos"), parts[9:], strict=False)),
    }


def graph():
    return [token(str(reply.ok.key_expr)) for reply in session.liveliness().get(f"@ros2_lv/{domain}/**") if reply.ok]


def key_of(kind, name):
    """The key of a publisher's topic or of a service, once the graph has it."""
    end = time.monotonic() + WAIT_SEC
    while time.monotonic() < end:
        for one in graph():
            if (one["kind"], one.get("name")) == (kind, name):
                return f"{domain}/{name.strip('/')}/{one['type']}/{one['hash']}"
        time.sleep(STEP_SEC)
    sys.exit(f"{name} did not come within {WAIT_SEC} s")


def latched(name, kind):
    came, got = threading.Event(), []

    def take(sample):
        got.append(decode(sample.payload, kind))
        came.set()

    subscriber = ext.declare_advanced_subscriber(
        session,
        key_of("MP", name),
        zenoh.handlers.Callback(take, indirect=False),
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
    )
    if not came.wait(WAIT_SEC):
        sys.exit(f"nothing came on {name} within {WAIT_SEC} s")
    subscriber.undeclare()
    return got[-1]


def call(name, kind, request):
    attachment = ATTACHMENT.pack(1, time.time_ns(), len(SENDER), SENDER)
    payload = bytes(types.serialize_cdr(request, f"{kind}_Request"))
    for reply in session.get(key_of("SS", name), payload=payload, attachment=attachment, timeout=WAIT_SEC):
        number, _, _, sender = ATTACHMENT.unpack(reply.ok.attachment.to_bytes())
        if (number, sender) != (1, SENDER):
            sys.exit(f"the answer is to request {number} of {sender!r}")
        return decode(reply.ok.payload, f"{kind}_Response")
    sys.exit(f"{name} did not answer")


config = zenoh.Config()
for setting, value in {
    "mode": "peer",
    "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
    "listen/endpoints": ["tcp/127.0.0.1:0"],
    "scouting/multicast/enabled": False,
}.items():
    config.insert_json5(setting, json.dumps(value))

with zenoh.open(config) as session:
    field = latched("/octn/field", "sensor_msgs/msg/CompressedImage")
    data = bytes(field.data)
    (length,) = struct.unpack_from("<Q", data)  # a safetensors file begins with its header in JSON
    header = json.loads(data[8 : 8 + length])
    request = message(f"{GET_PLAN}_Request", start=corner(*rectangle[:2]), goal=corner(*rectangle[2:]), tolerance=5e-5)
    path = call("/octn/plan_raster", GET_PLAN, request).plan
    positions = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in path.poses]
    told = {
        "graph": graph(),
        "field": {"format": field.format, "stamp": field.header.stamp.sec, "size": len(data), "header": header},
        "path": {"frame": path.header.frame_id, "positions_m": positions},
    }
print(json.dumps(told), flush=True)
