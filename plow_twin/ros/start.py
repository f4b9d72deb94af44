"""Initialize ROS 2 in a program."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from plow_twin.errors import PlowTwinError


class RosArgumentsError(PlowTwinError):
    """The arguments after `--ros-args`, or a file in these arguments, are invalid."""


def start_ros(arguments: Sequence[str] | None) -> None:
    """Initialize the default context of ROS with `arguments`, by default with the arguments of the process.

    ROS installs no signal handlers, because the program handles signals itself. Raise `RosArgumentsError` if the
    arguments for ROS are invalid.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    with _said_plainly():
        rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO)


@contextmanager
def ros() -> Iterator[None]:
    """Initialize ROS without signal handlers, and shut it down when the context ends."""
    import rclpy.utilities

    start_ros([])
    try:
        yield
    finally:
        rclpy.utilities.try_shutdown()


def without_ros(arguments: Sequence[str]) -> list[str]:
    """Return the arguments of a command line that are not arguments for ROS.

    Raise `RosArgumentsError` if the arguments for ROS are invalid.
    """
    from rclpy.utilities import remove_ros_args

    with _said_plainly():
        own: list[str] = remove_ros_args(list(arguments))
    return own


@contextmanager
def _said_plainly() -> Iterator[None]:
    """Convert an exception of rclpy to an error whose message has no line numbers of rcl."""
    try:
        yield
    except RuntimeError as error:
        raise RosArgumentsError(f"--ros-args: {re.sub(r', at [^ ,]+:[0-9]+', '', str(error))}") from error
