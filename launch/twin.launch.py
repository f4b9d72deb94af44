"""Start the twin: `ros2 launch plow_twin twin.launch.py scene:=paper record_path:=runs/monday`.

The arguments `scene`, `record_path`, `use_sim_time` and `autostart` override the parameter file only if they are given.
With `autostart:=false` the node waits for lifecycle requests (`ros2 lifecycle set /plow_twin configure`).
With `view:=true` a separate process shows the recording in a browser while it is written; it prints the address. The
program may be in another Python environment (`view:=/opt/viewer/bin/plow-twin`): rerun needs numpy 2, ROS 2 Jazzy has
1.26.
"""

import shutil

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription

ARGUMENTS = {
    "namespace": ("", "namespace of the node and its topics"),
    "params_file": ("", "parameter file; empty: the defaults of the node"),
    "scene": ("", "scene file or preset; empty: as in params_file"),
    "record_path": ("", "folder to make for the recording; empty: as in params_file"),
    "use_sim_time": ("", "take the time from /clock; empty: as in params_file"),
    "autostart": ("", "configure and activate at start; empty: as in params_file"),
    "view": (
        "",
        "true, or the program plow-twin of the environment that has rerun; needs record_path; empty: not shown",
    ),
}

#: Types of the parameters that have arguments of their own.
OVERRIDES = {"scene": str, "record_path": str, "use_sim_time": bool, "autostart": bool}

#: Prefix that stops a process when `launch` has ended, since `launch` ends at SIGTERM without stopping its processes.
STOP_WITH_LAUNCH = "setpriv --pdeathsig TERM" if shutil.which("setpriv") else ""


def actions(context: LaunchContext) -> list[Node | ExecuteProcess]:
    """Return the node, and its viewer if the argument `view` is given."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    if given["view"] in ("", "false"):
        return [twin(given)]
    if not given["record_path"]:
        raise ValueError(f"view: got {given['view']} without record_path, expected record_path:=FOLDER, which is shown")
    return [twin(given), viewer(given)]


def twin(given: dict[str, str]) -> Node:
    """Return the node. Arguments that are not empty override the parameter file."""
    overrides = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, kind in OVERRIDES.items()
        if given[name]
    }
    return Node(
        package="plow_twin",
        executable="twin",
        name="plow_twin",
        namespace=given["namespace"],
        parameters=[*filter(None, [given["params_file"]]), overrides],
        # the node may take up to 5 s to close its recording
        sigterm_timeout="6",
        sigkill_timeout="6",
        prefix=STOP_WITH_LAUNCH,
        exec_name="twin",
        output="screen",
    )


def viewer(given: dict[str, str]) -> ExecuteProcess:
    """Return the process that shows the recording while it is written."""
    # the viewer has a Python environment of its own, so the variables that a sourced ROS 2 adds are removed
    apart = [
        "env",
        *(f"--unset={name}" for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")),
    ]
    program = "plow-twin" if given["view"] == "true" else given["view"]
    return ExecuteProcess(
        cmd=[*apart, program, "view", given["record_path"], "--follow", "--wait", "600", "--web"], output="screen"
    )


def generate_launch_description() -> LaunchDescription:
    """Return one twin, and its viewer if the argument `view` is given."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=actions)])
