"""The life of a node's process: from its arguments to its exit code."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import remove_ros_args

from octn_ros.errors import OctnError, in_words
from octn_ros.nodes.parameters import undeclared_parameters
from octn_ros.nodes.worker import any_working

NEW_OBJECTS = 100_000  # after which the collector looks for cycles
THREADS = 4  # a slow service, a slow subscription, and two for whatever else is asked meanwhile


def run(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Make a node and spin it until SIGINT, SIGTERM or a shutdown from outside.

    Args:
        make_node: makes the node; called once rclpy is initialised.
        args: command-line arguments with `--ros-args`, None for those of the process.

    Returns:
        The exit code: 0 after an ordered end, 2 for arguments or parameters that the node cannot start with.
    """
    interrupts = _Interrupts()  # before rclpy's own handler, which calls this one
    try:
        unknown = remove_ros_args(args)[1:]
        if not unknown:
            rclpy.init(args=args)
    except Exception as error:  # of rcl's own type, which rclpy does not export, or of a file that cannot be read
        return _refuse(f"expected arguments and an environment that ROS can start with, got {in_words(error)}")
    if unknown:
        return _refuse(
            f"expected nothing but --ros-args ..., got {' '.join(unknown)}; parameters are given as "
            "--ros-args -p NAME:=VALUE"
        )
    node, code = None, 1  # of an error that comes out
    try:
        # Before the node says that it is ready: rclpy complains of an executor that a signal leaves half made.
        executor = MultiThreadedExecutor(num_threads=THREADS)
        node = make_node()
        # What was imported and made so far stays, so the collector need not walk through it again and again; and it
        # looks less often than at every 700 new objects: a path of 10,000 poses is 40,000 of them, and takes four
        # times as long to make where the collector counts them.
        gc.freeze()
        gc.set_threshold(NEW_OBJECTS)
        for name in undeclared_parameters(node):
            node.get_logger().warning(f"there is no parameter {name}; what was given for it is ignored")
        executor.add_node(node)
        interrupts.hold()
        executor.spin()
        code = 0
    except (KeyboardInterrupt, ExternalShutdownException):
        code = 0
    except (OctnError, InvalidParameterTypeException, InvalidParameterValueException) as error:
        if node is not None:
            raise  # not a matter of parameters: an error that a callback should have caught
        code = _refuse(f"{error}{_remedy(error)}")
    except Exception:
        # A signal between the executor's look at the context and its wait makes Jazzy raise RCLError, which rclpy
        # does not export. Without a context there is nothing left to run, so it is an ordered end.
        if rclpy.ok():
            raise
        code = 0
    finally:
        _ignore_signals()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        _ignore_signals()  # rclpy has put back the handlers from before
        leave_workers_behind(code)
    return code


class _Interrupts:
    """What SIGINT does beside shutting the context down, from now on: it raises KeyboardInterrupt, at most once.

    An exception that comes out anywhere can leave things half done. In the start of the executor's first thread it
    leaves one that concurrent.futures does not know of and never ends, and Python would wait for it for ever.
    """

    def __init__(self) -> None:
        self._raises = True
        signal.signal(signal.SIGINT, self._interrupt)

    def hold(self) -> None:
        """Raise no more: the spinning executor sees that the context was shut down, as after SIGTERM."""
        self._raises = False

    def _interrupt(self, *_: object) -> None:
        if self._raises:
            self._raises = False
            raise KeyboardInterrupt


def _refuse(reason: str) -> int:
    """Say why the process does not start; return its exit code."""
    rclpy.logging.get_logger("octn_ros").fatal(reason)
    return 2


def _remedy(error: Exception) -> str:
    """The most common slip: ROS 2 takes a number without a point for an integer, and no integer for a float."""
    if not isinstance(error, InvalidParameterTypeException):
        return ""
    if "'DOUBLE_ARRAY'" in str(error):
        return "; a list of numbers is given in brackets, all with a point, as '[28.0, 14.59, 14.0]'"
    slip = "'INTEGER'" in str(error) and "'DOUBLE'" in str(error)
    return "; a number without decimals is given with a point, as 50.0" if slip else ""


def _ignore_signals() -> None:
    """Let no second signal break an ordered end: launched without a terminal, a node gets SIGINT twice."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def leave_workers_behind(code: int = 0) -> None:
    """See to it that the process ends, with an exit code, without waiting for the threads that still work, if any."""
    if any_working():
        # Before the interpreter waits for the threads that run kernels, which may be compiling for seconds; that is
        # where concurrent.futures registers this wait, and atexit comes after it.
        getattr(threading, "_register_atexit", atexit.register)(_leave, code)


def _leave(code: int) -> None:
    """Leave the interpreter as it is: taken down under a thread that still computes in C++, it would abort."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
