"""The launch file as `colcon test` runs it: launch_testing starts the twin, listens to it and checks its end."""

from __future__ import annotations

import time
import unittest
from pathlib import Path
from typing import Any

import pytest

# both packages are part of a ROS 2 installation and are not on PyPI
pytest.importorskip("launch_testing")
pytest.importorskip("launch_ros")

import launch_testing.actions
import launch_testing.asserts
import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from launch import LaunchDescription

#: Time limit [s] that is sufficient for the first compilation of the solver on a slow machine.
START_S = 200.0

try:
    LAUNCH_FILE = Path(get_package_share_directory("plow_twin"), "launch", "twin.launch.py")
except PackageNotFoundError:
    pytest.skip("plow_twin is not installed by colcon", allow_module_level=True)


@pytest.mark.launch_test
def generate_test_description() -> LaunchDescription:
    twin = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(LAUNCH_FILE)), launch_arguments={"namespace": "launched"}.items()
    )
    return LaunchDescription([twin, launch_testing.actions.ReadyToTest()])


class TestWhileItRuns(unittest.TestCase):
    def test_the_twin_reports_that_it_is_active(self) -> None:
        rclpy.init()
        self.addCleanup(rclpy.shutdown)
        node = rclpy.create_node("listener")
        texts: list[str] = []

        def hear(message: Any) -> None:
            texts.extend(f"{value.key}={value.value}" for one in message.status for value in one.values)

        node.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
        give_up = time.monotonic() + START_S
        while "lifecycle=active" not in texts:
            assert time.monotonic() < give_up, texts
            rclpy.spin_once(node, timeout_sec=0.2)
        node.destroy_node()


@launch_testing.post_shutdown_test()
class TestAfterItsEnd(unittest.TestCase):
    def test_the_twin_has_ended_with_code_0(self, proc_info: Any) -> None:
        launch_testing.asserts.assertExitCodes(proc_info)
