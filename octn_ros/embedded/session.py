"""The Zenoh session of a process: how processes on one machine find each other without a router or multicast."""

from __future__ import annotations

import ctypes
import json
import os
import re
import sys
from typing import Any

import zenoh

from octn_ros.embedded.errors import RCLError

CONFIG_OVERRIDE = "ZENOH_CONFIG_OVERRIDE"  # rmw_zenoh's name, form and meaning
PORT_VARIABLE = "OCTN_RENDEZVOUS_PORT"
RENDEZVOUS_PORT = 17447  # plus the domain id; on loopback
LARGEST_PORT = 65535
ROUTER_PORT = 7447  # where rmw_zenohd listens, if there is one
LARGEST_KEPT_BLOCK = 1 << 30
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h


def session_config(domain_id: int) -> dict[str, Any]:
    """Return, by Zenoh's keys, the configuration of a peer as rmw_zenoh_cpp's that finds others without a router.

    One process listens at the rendezvous port, the others connect to it and learn of each other by gossip. All try to
    listen again and again, so another takes the port over when its holder ends. Everything stays on loopback: any user
    of the machine can join, nobody else. `config_overrides` may change that.

    The environment variable OCTN_RENDEZVOUS_PORT sets the port, which is 17447 plus the domain id.

    Raises:
        RCLError: OCTN_RENDEZVOUS_PORT is no port.
    """
    given = os.environ.get(PORT_VARIABLE, str(RENDEZVOUS_PORT + domain_id))
    if not given.isdecimal() or not 1 <= int(given) <= LARGEST_PORT:
        raise RCLError(f"{PORT_VARIABLE}: expected a port, 1 to {LARGEST_PORT}, got '{given}'")
    port = int(given)
    retry = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2}
    everyone = {"router": ["router", "peer"], "peer": ["router", "peer"]}
    queue = "transport/link/tx/queue"
    return {
        "mode": "peer",
        "connect/endpoints": [f"tcp/127.0.0.1:{port}", f"tcp/127.0.0.1:{ROUTER_PORT}"],
        "connect/timeout_ms": -1,  # with 0 it would try once and never find a router or holder that starts later
        "connect/exit_on_failure": False,
        "connect/retry": {**retry, "period_max_ms": 2000},
        "listen/endpoints": [f"tcp/127.0.0.1:{port}#exit_on_failure=false", "tcp/127.0.0.1:0"],
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "listen/retry": retry,
        "scouting/delay": 100,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "scouting/gossip/target": everyone,
        "scouting/gossip/autoconnect": {"router": [], "peer": everyone["peer"]},
        "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
        "timestamping/enabled": True,  # the cache behind latched topics needs it
        # Zenoh's defaults lose or slow down messages of many MB.
        f"{queue}/size/data": 16,
        f"{queue}/congestion_control/drop/wait_before_drop": 100_000,
        f"{queue}/congestion_control/drop/max_wait_before_drop_fragments": 5_000_000,
        f"{queue}/congestion_control/block/wait_before_close": 60_000_000,
        "transport/link/rx/buffer_size": 1 << 20,
    }


def config_overrides() -> dict[str, str]:
    """Return what the environment variable ZENOH_CONFIG_OVERRIDE puts in place of `session_config`, as JSON5 by key.

    Its form is rmw_zenoh's, ``key=value;key=value`` with values in JSON5. A semicolon within double quotes belongs to
    the value; spaces and line ends around keys and values do not.

    Raises:
        RCLError: a part of it is no ``key=value``.
    """
    parts = re.findall(r'(?:[^";]|"[^"]*"|")+', os.environ.get(CONFIG_OVERRIDE, ""))
    pairs = [part.partition("=") for part in map(str.strip, parts) if part]
    for key, equals, value in pairs:
        if not (key.strip() and equals and value.strip()):
            raise RCLError(f"{CONFIG_OVERRIDE}: expected key=value;key=value, got '{key}{equals}{value}'")
    return {key.strip(): value.strip() for key, _, value in pairs}


def open_session(domain_id: int) -> zenoh.Session:
    """Open the session of a context.

    Also sets malloc thresholds for the whole process: see `_keep_large_blocks`. A process must not fork afterwards
    (use the spawn method of multiprocessing).

    Raises:
        RCLError: OCTN_RENDEZVOUS_PORT is no port; ZENOH_CONFIG_OVERRIDE is not of its form, or has a key or value that
            Zenoh does not know.
        zenoh.ZError: no socket on loopback can be had, or what the override asks for cannot be opened.
    """
    _keep_large_blocks()
    config = zenoh.Config()
    for key, value in session_config(domain_id).items():
        config.insert_json5(key, json.dumps(value))
    for key, text in config_overrides().items():
        try:
            config.insert_json5(key, text)
        except zenoh.ZError as error:
            raise RCLError(f"{CONFIG_OVERRIDE}: Zenoh refuses {key}={text}: {error}") from error
    return zenoh.open(config)


def _keep_large_blocks() -> None:
    """Keep freed blocks of up to 1 GiB in the heap of this process, where the C library is glibc.

    By default glibc maps, faults in and unmaps memory for every large message, which takes six times as long as
    copying it. The price is that a process keeps the memory of its largest messages. It holds for all code in the
    process, not only for ours.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BLOCK)
            mallopt(M_TRIM_THRESHOLD, LARGEST_KEPT_BLOCK)
