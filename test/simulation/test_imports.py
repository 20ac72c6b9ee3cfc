import subprocess
import sys


def test_simulation_and_assembly_need_neither_torch_nor_ros():
    code = "import sys, octn_ros.simulation, octn_ros.volume.assembly; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert not {"torch", "rclpy", "zenoh", "octn_ros.nodes", "octn_ros.embedded"} & set(loaded)
