"""The import hook, in processes of its own."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(code, *path):
    lines = f"import sys; sys.path[:0] = {[str(ROOT), *map(str, path)]!r}\n{code}"
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_importing_the_package_loads_neither_zenoh_nor_rosbags_nor_rclpy():
    code = "import octn_ros.embedded; print([m for m in ('zenoh', 'rosbags', 'rclpy', 'numpy') if m in sys.modules])"
    assert run(code) == ["[]"]


def test_installing_loads_nothing_either_and_twice_is_once():
    code = (
        "import octn_ros.embedded as e; print(e.install(), e.install(),"
        "sum(getattr(f, '__name__', '') == 'EmbeddedFinder' for f in sys.meta_path), 'zenoh' in sys.modules)"
    )
    assert run(code) == ["True", "True", "1", "False"]


def test_a_genuine_rclpy_wins(tmp_path):
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text("genuine = True\n")
    code = (
        "import octn_ros.embedded as e; print(e.install()); import rclpy; print(rclpy.genuine, 'zenoh' in sys.modules)"
    )
    assert run(code, tmp_path) == ["False", "True", "False"]


def test_a_genuine_rclpy_wins_also_when_it_appears_after_install(tmp_path):
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text("genuine = True\n")
    code = (
        "import octn_ros.embedded as e; print(e.install());"
        f"sys.path.insert(0, {str(tmp_path)!r}); import rclpy; print(rclpy.genuine)"
    )
    assert run(code) == ["True", "True"]


@pytest.mark.parametrize("name", ["zenoh", "rosbags"])
@pytest.mark.parametrize("wanted", ["rclpy", "std_msgs.msg"])
def test_a_missing_requirement_names_the_command_that_installs_it(name, wanted):
    code = (
        f"import octn_ros.embedded as e; e.install(); sys.modules[{name!r}] = None\n"
        f"try: import {wanted}; {wanted}.__all__, {wanted}.String\n"
        "except ImportError as error: print(error)"
    )
    told = " ".join(run(code))
    assert "pip install 'octn_ros[embedded]'" in told
    assert f"'{name}'" in told


def test_foreign_names_stay_foreign():
    code = (
        "import importlib.util as u, octn_ros.embedded as e; e.install();"
        "print(u.find_spec('my_msgs'), u.find_spec('trajectory_msgs'), 'rosbags' in sys.modules)"
    )
    assert run(code) == ["None", "None", "False"]


def test_the_runtime_is_not_imported_under_another_name():
    with pytest.raises(ImportError, match="only to be imported as rclpy"):
        importlib.import_module("octn_ros.embedded.rclpy")


def test_a_process_that_closes_nothing_ends_by_itself(graph):
    code = (
        "import octn_ros.embedded as e; e.install(); import rclpy; from rclpy.node import Node; from std_msgs.msg "
        "import String; rclpy.init(args=[]); n = Node('left_open'); n.create_subscription(String, 'x', print, 1)"
    )
    assert run(code) == []
