"""The program `twin`, which runs one node in one process and stops cleanly at a stop signal (`live.stop`)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from plow_twin.errors import printable
from plow_twin.live.stop import StopRequested, StopSignals

if TYPE_CHECKING:
    from rclpy.executors import Executor

#: Longest wait for an event [s]. Without a limit, the events executor would not return at shutdown.
_SPIN_S: Final = 0.1


def make_executor() -> Executor:
    """Return the events executor, which is the fastest, or a single-threaded executor if rclpy does not have it."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until a stop signal arrives; return 0, or 2 if the arguments or parameters are invalid."""
    _parser().parse_known_args(arguments)
    stop = StopSignals()
    try:
        return _run(arguments, stop)
    except StopRequested:
        return 0
    finally:
        stop.ignore()


def _parser() -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        "twin",
        usage="twin [--help] [--ros-args -p NAME:=VALUE ... --params-file FILE -r FROM:=TO ...]",
        description="Run the twin as a ROS 2 lifecycle node until SIGINT or SIGTERM.",
        epilog="Parameters with units and ranges: config/twin.yaml. Exit codes: 0 stopped, 2 wrong arguments.",
        allow_abbrev=False,
    )


def _run(arguments: Sequence[str] | None, stop: StopSignals) -> int:
    # the imports follow the installation of the signal handlers, so that a signal during an import causes no traceback
    import rclpy.utilities

    from plow_twin.live.parameters import ParameterError
    from plow_twin.live.solver_start import leave
    from plow_twin.ros.node import TwinNode
    from plow_twin.ros.start import RosArgumentsError, start_ros

    node = None
    try:
        start_ros(arguments)
        node = TwinNode(stop_asked=lambda: stop.stopped)
        stop.interrupt = False
        executor = make_executor()
        executor.add_node(node)
        starting = node.autostart
        if starting:
            node.prepare()
        while not stop.stopped and rclpy.utilities.ok():
            if starting and node.prepared:
                starting = False
                if node.lifecycle == "unconfigured":  # a lifecycle manager may already have configured the node
                    node.start()
            executor.spin_once(timeout_sec=_SPIN_S)
        executor.remove_node(node)
    except (ParameterError, RosArgumentsError) as error:
        print(f"twin: {printable(str(error))}", file=sys.stderr)
        return 2
    finally:
        stop.interrupt = False
        if node is not None:
            node.release()
            node.destroy_node()
        rclpy.utilities.try_shutdown()
    return leave(0)


if __name__ == "__main__":
    sys.exit(main())
