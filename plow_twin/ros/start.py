"""Start of the ROS 2 programs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from plow_twin.errors import PlowTwinError


class RosArgumentsError(PlowTwinError):
    """The arguments after `--ros-args`, or a file that they name, cannot be used."""


def start_ros(arguments: Sequence[str] | None) -> None:
    """Make the default context of ROS with the given arguments, or those of the process; the program handles signals
    itself.
    """
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    with _said_plainly():
        rclpy.init(args=None if arguments is None else list(arguments), signal_handler_options=SignalHandlerOptions.NO)


@contextmanager
def ros() -> Iterator[None]:
    """Join the ROS graph; the program handles signals itself."""
    import rclpy.utilities

    start_ros([])
    try:
        yield
    finally:
        rclpy.utilities.try_shutdown()


def without_ros(arguments: Sequence[str]) -> list[str]:
    """Return the program's own arguments of a command line; raise RosArgumentsError if those for ROS cannot be used."""
    from rclpy.utilities import remove_ros_args

    with _said_plainly():
        own: list[str] = remove_ros_args(list(arguments))
    return own


@contextmanager
def _said_plainly() -> Iterator[None]:
    """Turn rclpy's exception into an error without places in rcl's sources."""
    try:
        yield
    except RuntimeError as error:
        raise RosArgumentsError(f"--ros-args: {re.sub(r', at [^ ,]+:[0-9]+', '', str(error))}") from error
