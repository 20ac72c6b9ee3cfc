"""The import hook: finds `rclpy` and the message packages where nothing else on `sys.meta_path` does."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

from octn_ros.embedded.absent import ABSENT_MODULES
from octn_ros.embedded.errors import needs_ros2

_MESSAGES = {f"{name}_msgs" for name in ("diagnostic", "geometry", "nav", "rosgraph", "sensor", "std", "tf2")}
PACKAGES = _MESSAGES | {"builtin_interfaces", "rcl_interfaces", "std_srvs", "visualization_msgs"}
RCLPY = Path(__file__).parent / "rclpy"


class EmbeddedFinder:
    """Finder and loader in one; stands last on `sys.meta_path`, so an installed ROS 2 always wins.

    It imports nothing for names that are not its own, as an import inside a finder would call it again.
    """

    @classmethod
    def find_spec(
        cls, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of `rclpy`, of a message package or module, or None for foreign names."""
        package, _, rest = name.partition(".")
        if name == "rclpy":
            return importlib.util.spec_from_file_location(
                name, RCLPY / "__init__.py", submodule_search_locations=[str(RCLPY)]
            )
        if package == "rclpy" and name in ABSENT_MODULES:
            return ModuleSpec(name, cls)  # type: ignore[arg-type]
        if package in PACKAGES and (not rest or rest.partition(".")[0] in ("msg", "srv")):
            return ModuleSpec(name, cls, is_package=rest in ("", "msg", "srv"))  # type: ignore[arg-type]
        return None

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        """Leave the making of the module to Python."""

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        """Fill a message package; its classes are made at first use.

        Raises:
            ImportError: the packages of the extra are missing, or there is no such module of messages.
            NotImplementedError: a module of rclpy that needs ROS 2.
        """
        package, _, rest = module.__name__.partition(".")
        if package == "rclpy":
            raise needs_ros2(module.__name__)
        kind, _, submodule = rest.partition(".")
        if not kind:
            return
        from octn_ros.embedded import definitions, message

        names = definitions.names(package, kind)
        if submodule:  # where rclpy keeps the class, e.g. std_msgs.msg._string; pickles refer to it
            names = [n for n in names if definitions.module_name(n) == submodule]
            if not names:
                raise ImportError(f"no module named {module.__name__!r}", name=module.__name__)
            if kind == "srv":
                names = [f"{n}{part}" for n in names for part in ("", "_Request", "_Response")]
        make = message.message_class if kind == "msg" else message.service_class

        def attribute(name: str) -> Any:
            if name not in names:
                raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
            value = (message.message_class if "_" in name else make)(f"{package}/{kind}/{name}")
            setattr(module, name, value)
            return value

        module.__dict__.update(__all__=names, __getattr__=attribute)
