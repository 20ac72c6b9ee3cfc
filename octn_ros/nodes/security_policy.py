"""The text of config/sros2/policy.xml: what each node may do, which is what it does, and no more.

Write it again with `python -m octn_ros.nodes.security_policy > config/sros2/policy.xml`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence

from octn_ros.nodes.every_node import print_text
from octn_ros.nodes.interfaces import OFFERS, PARAMETER_SERVICES, PUBLISHES, SUBSCRIBES, Interface, all_interfaces

NAMESPACE = "/octn"
OPERATOR, VIEWER = "client", "viewer"  # who may ask and fire, and who may only look
# A real scanner and a real arm in place of the simulator, as docs/connecting.md has them.
SCANNER = {"publish": ("bscan", "bscan_pose"), "subscribe": (), "reply": ("scan",)}
ARM = {
    "publish": ("ee_pose", "execution_status"),
    "subscribe": ("/diagnostics", "plan_status", "scan_ee_pose", "tool_path", "waypoints", "waypoints_base"),
    "reply": ("abort", "enable_laser", "execute"),
}
_HEAD = """\
<?xml version="1.0" encoding="UTF-8"?>
<!-- Who may do what in the graph, for `ros2 security` (docs/security.md): each node what its own code does, the
     operator all services, the viewer topics only. The default of SROS2 is to deny.
     Written by `python -m octn_ros.nodes.security_policy`, and held against the code by a test. -->
<policy version="0.2.0">
  <enclaves>"""
_TAIL = """\
  </enclaves>
</policy>
"""
_OWN = ("get_type_description", *PARAMETER_SERVICES)


def security_policy(nodes: Sequence[Sequence[Interface]]) -> str:
    """Return the text of the policy for nodes in the namespace /octn.

    Args:
        nodes: what each node offers and takes.
    """
    everything = [interface for interfaces in nodes for interface in interfaces]
    topics = {interface.name for interface in everything if interface.role == PUBLISHES}
    asked = (
        {interface.name for interface in everything if interface.role != PUBLISHES}
        - topics
        - {interface.name for interface in everything if interface.role == OFFERS}
    )
    services = {interface.name for interface in everything if interface.role == OFFERS}
    settable = {f"{interfaces[0].node}/{name}" for interfaces in nodes for name in PARAMETER_SERVICES}
    lines = [_HEAD]
    for interfaces in nodes:
        published, heard, offered = (
            {interface.name for interface in interfaces if interface.role == role}
            for role in (PUBLISHES, SUBSCRIBES, OFFERS)
        )
        lines += _enclave(interfaces[0].node, published, heard, reply=offered)
    lines += _enclave("scanner", **SCANNER)
    lines += _enclave("arm", **ARM)
    lines += _enclave(OPERATOR, asked, topics, request=services | settable)
    lines += _enclave(VIEWER, set(), topics)
    return "\n".join([*lines, _TAIL])


def _enclave(
    node: str,
    publish: Collection[str],
    subscribe: Collection[str],
    *,
    reply: Collection[str] = (),
    request: Collection[str] = (),
) -> Iterator[str]:
    own = {f"~/{name}" for name in _OWN}
    yield f'    <enclave path="{NAMESPACE}/{node}">'
    yield "      <profiles>"
    yield f'        <profile ns="{NAMESPACE}" node="{node}">'
    yield from _rule("topic", "publish", {"/parameter_events", "/rosout", *publish})
    yield from _rule("topic", "subscribe", {"/clock", "/parameter_events", *subscribe})
    # rmw opens both ends of a node's own parameter services.
    yield from _rule("service", "reply", own | set(reply))
    yield from _rule("service", "request", own | set(request))
    yield "        </profile>"
    yield "      </profiles>"
    yield "    </enclave>"


def _rule(what: str, may: str, names: Iterable[str]) -> Iterator[str]:
    yield f'          <{what}s {may}="ALLOW">'
    for name in sorted(names):
        yield f"            <{what}>{name}</{what}>"
    yield f"          </{what}s>"


if __name__ == "__main__":
    print_text(lambda: security_policy(list(all_interfaces())))
