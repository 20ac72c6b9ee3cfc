"""The rules of the house: which room may import which, what importing loads, how long a file may be."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import octn_ros

REPOSITORY = Path(__file__).parents[1]
PACKAGE = REPOSITORY / "octn_ros"
MAX_LINES = 500

# What each room may import of the others; everything may import errors and settings.
ALLOWED = {
    "volume": set(),
    "metrics": set(),
    "field": {"volume"},
    "training": {"volume", "field", "metrics"},
    "query": {"volume", "field"},
    "planning": {"volume", "field", "query", "metrics"},
    "simulation": {"volume", "planning", "metrics"},
    "evaluation": {"volume", "field", "training", "query", "planning", "simulation", "metrics", "demo"},
    "embedded": set(),
}
CORE = [room for room in ALLOWED if room != "embedded"]


def modules():
    return sorted(PACKAGE.rglob("*.py"))


def imports(path):
    """Return every absolute module name that a file imports, also inside functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names if node.module == "octn_ros")
    return names


def test_dependencies_point_one_way():
    wrong = []
    for room, allowed in ALLOWED.items():
        assert (PACKAGE / room).is_dir(), room
        for path in (PACKAGE / room).rglob("*.py"):
            for name in imports(path):
                match = re.match(r"octn_ros\.(\w+)", name)
                if match and match[1] not in {room, "errors", "settings", "__version__", *allowed}:
                    wrong.append(f"{path.relative_to(PACKAGE)} imports {name}")
    assert not wrong


def test_conversions_alone_turn_messages_into_arrays():
    for path in (PACKAGE / "nodes").rglob("*.py"):
        if path.parent.name == "conversions":
            continue
        used = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        packing = used & {"frombuffer", "tobytes", "frombytes"}
        assert not packing, f"{path.name} packs or unpacks bytes itself ({packing}); that belongs in nodes/conversions"


def refuse_loaded(rooms, refused):
    """Import one room after the other in one process, which takes seconds to load torch."""
    code = (
        "import importlib, sys\n"
        f"for room in {rooms}:\n"
        "    importlib.import_module(f'octn_ros.{room}')\n"
        f"    loaded = {refused} & set(sys.modules)\n"
        "    assert not loaded, f'{room} loads {loaded}'\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr


def test_the_core_loads_neither_ros_nor_transport():
    rooms = ["errors", "settings", "resources", "cli", *CORE]
    refuse_loaded(rooms, {"rclpy", "zenoh", "rosbags", "octn_ros.nodes", "octn_ros.embedded"})


def test_rooms_without_a_model_load_no_torch():
    refuse_loaded(["volume", "metrics", "cli"], {"torch"})


def test_no_file_is_too_long_or_named_after_nothing():
    for path in modules():
        assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES, path
        assert path.stem not in {"utils", "helpers", "common", "misc"}, path


def test_test_files_have_names_of_their_own():
    # The pytest plugins of ROS 2 import test files by their bare names.
    names = [path.name for path in (REPOSITORY / "test").rglob("test_*.py")]
    assert len(names) == len(set(names))


def test_one_version_everywhere():
    xml = (REPOSITORY / "package.xml").read_text(encoding="utf-8")
    assert f"<version>{octn_ros.__version__}</version>" in xml


def test_every_message_package_is_declared():
    declared = set(re.findall(r"<exec_depend>(\w+)</exec_depend>", (REPOSITORY / "package.xml").read_text()))
    used = set()
    for path in [*(PACKAGE / "nodes").rglob("*.py"), *(PACKAGE / "demo").rglob("*.py")]:
        used |= {name.split(".")[0] for name in imports(path)}
    used = {name for name in used if re.fullmatch(r"\w+_(msgs|srvs|interfaces)|rclpy", name)}
    assert used
    assert used <= declared
