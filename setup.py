"""Build description for pip and colcon (ament_python)."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

HERE = Path(__file__).resolve().parent  # colcon --symlink-install runs a link to this file
# package.xml holds the one version number that ROS tools read; octn_ros.__version__ is tested against it.
VERSION = ElementTree.parse(HERE / "package.xml").findtext("version")

BENCH = [
    # `octn bench NAME --data DIR`: the scans of a folder side by side, on this machine or on a cluster. A scheduler
    # that survives workers that die is nothing to write oneself.
    "distributed>=2024.4",
]
EMBEDDED = [
    # The transport and the message definitions of the runtime that stands in for rclpy where ROS 2 is missing.
    # The extensions of eclipse-zenoh that latched topics need are marked unstable, hence the narrow range.
    "eclipse-zenoh>=1.10,<1.11",
    "rosbags>=0.11,<0.12",
    "xxhash>=3.0",
    "mcap>=1.2,<2",  # with these, all that `octn demo --record` needs is there
]
RECORD = [
    # `octn demo --record`: one file that Foxglove opens. The writer is that of the format's makers; rosbags, whose
    # own writer makes a folder of a file and a YAML, knows the schemas.
    "mcap>=1.2,<2",
    "rosbags>=0.11,<0.12",
]
VENDOR = [
    # Files of Topcon, Heidelberg, Bioptigen, Optovue and Zeiss. It brings OpenCV along, so it is not for everyone.
    "oct-converter>=0.7,<0.8",
]
TEST = [
    *BENCH,
    *EMBEDDED,
    "hypothesis>=6.100",
    "mcap-ros2-support>=0.5",  # reads our recordings as Foxglove does
    "mypy>=1.10",
    "pytest>=7.4",
    "pytest-timeout>=2.2",
    "pytest-xdist>=3.6",  # two processes: many tests wait for others, and two cores are everywhere
    "ruff>=0.6",
    "trimesh>=4.0",  # reads the meshes we write
    # Its interpreter runs the GPU's kernels on the CPU, and its compiler builds them for GPUs that are not there.
    # PyTorch for CUDA brings its own along; for other machines there is none.
    'triton>=3.3; platform_system == "Linux" and platform_machine == "x86_64"',
    "types-PyYAML",
]

setup(
    name="octn_ros",
    version=VERSION,
    description="Neural OCT fields for robot-guided surgery: C-scan in, laser waypoints out",
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="octn_ros maintainers",
    maintainer_email="maintainers@octn-ros.example",
    packages=find_packages(include=["octn_ros", "octn_ros.*"]),
    package_data={"octn_ros": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/octn_ros"]),
        ("share/octn_ros", ["package.xml"]),
        # setuptools takes relative names only, which is what PTH207 is about
        ("share/octn_ros/config", ["config/fast_dds.xml", *glob("config/*.yaml")]),  # noqa: PTH207
        ("share/octn_ros/config/sros2", glob("config/sros2/*.xml")),  # noqa: PTH207
        ("share/octn_ros/foxglove", glob("foxglove/*.json")),  # noqa: PTH207
        ("share/octn_ros/launch", glob("launch/*.launch.py")),  # noqa: PTH207
        ("share/octn_ros/rviz", glob("rviz/*.rviz")),  # noqa: PTH207
    ],
    python_requires=">=3.10",
    install_requires=[
        "h5py>=3.10",  # MATLAB 7.3 and HDF5 files
        "matplotlib>=3.6",  # pictures of the report
        "nibabel>=5.0",  # NIfTI
        "numba>=0.60",  # compiled fits and queries on the CPU, without a compiler on the user's machine
        "numpy>=1.26",
        "pillow>=10.1",  # folders of numbered images; words on pictures in a size of choice (10.1)
        "pydicom>=3.0",  # DICOM ophthalmic tomography
        "pyyaml>=6.0",  # calibration files
        "rich>=13.0",  # tables and progress bars
        "safetensors>=0.4",  # checkpoints that run nothing when loaded
        "scikit-image>=0.22",  # marching cubes, SSIM
        "scipy>=1.11",  # filters, KD-tree, rotations
        "tifffile>=2023.7",  # TIFF stacks
        "torch>=2.4",  # Adam fused on the CPU
    ],
    extras_require={"bench": BENCH, "embedded": EMBEDDED, "record": RECORD, "test": TEST, "vendor": VENDOR},
    zip_safe=False,  # the embedded runtime is loaded from files of the package
    entry_points={
        "console_scripts": [
            "octn = octn_ros.cli:main",
            "trainer = octn_ros.nodes.trainer:main",
            "query = octn_ros.nodes.query:main",
            "planner = octn_ros.nodes.planner:main",
            "simulator = octn_ros.nodes.simulator:main",
        ]
    },
)
