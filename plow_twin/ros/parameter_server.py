"""Declare the parameters of a ROS node, and check changes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import Field, replace
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from plow_twin.live import parameters
from plow_twin.live.parameters import SPECS, Effect, Settings, refused_changes


def descriptor(spec: Field[Any]) -> ParameterDescriptor:
    """Return the ROS descriptor of a parameter."""
    unit = f" [{spec.metadata['unit']}]" if "unit" in spec.metadata else ""
    message = ParameterDescriptor(
        name=spec.name,
        description=f"{spec.metadata['doc']}{unit}; takes effect {spec.metadata['effect'].value}",
        additional_constraints=parameters.expected(spec),
        read_only=spec.metadata["effect"] is Effect.START,
    )
    if isinstance(spec.default, float):
        low, high = spec.metadata["low"], spec.metadata["high"]
        message.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif "unit" in spec.metadata and not isinstance(spec.default, tuple):
        low, high = spec.metadata["low"], spec.metadata["high"]
        message.integer_range = [IntegerRange(from_value=low, to_value=high, step=1)]
    return message


def _converted(parameter: Parameter) -> Parameter:
    """Return a parameter whose value is converted to the declared type, if possible.

    An empty list is not converted, because rclpy would read it as bytes.
    """
    if parameter.name not in SPECS or parameter.type_ is Parameter.Type.NOT_SET:
        return parameter
    value = parameters.coerce(parameter.name, parameter.value)
    is_converted = isinstance(value, float | tuple) and value != ()
    return Parameter(parameter.name, value=value) if is_converted else parameter


class ParameterServer:
    """Declaration of all parameters on a node. The attribute `settings` contains the current values.

    The node must be created with `automatically_declare_parameters_from_overrides=True`, so that the initial values can
    be read before rclpy checks their types. An integer is accepted for a double. All invalid values are listed in one
    error.

    `unconfigured` returns whether parameters that take effect on configure may change. `changed` receives the name and
    the value of a changed parameter that takes effect immediately. `refusals` returns the reasons why the twin cannot
    use new settings. Raise `ParameterError` if initial values are invalid.
    """

    def __init__(
        self,
        node: Node,
        unconfigured: Callable[[], bool],
        changed: Callable[[str, Any], None],
        refusals: Callable[[Settings], list[str]],
    ) -> None:
        self._node = node
        self._unconfigured = unconfigured
        self._changed = changed
        self._refusals = refusals
        declared: dict[str, Any] = dict(node.get_parameters_by_prefix(""))
        values = {name: parameter.value for name, parameter in declared.items()}
        self.unknown = dict(parameters.unknown(values))
        for name, nearest in self.unknown.items():
            hint = f"; did you mean {nearest}?" if nearest else ""
            node.get_logger().warning(f"unknown parameter {name}: {values[name]!r} is not used{hint}")
        self.settings: Settings = parameters.settings(values)
        if "scene" not in values:
            node.get_logger().warning(
                f"no parameter scene: the preset {self.settings.scene} is used, which is not your machine"
            )
        for name, spec in SPECS.items():
            if node.has_parameter(name):
                node.undeclare_parameter(name)
            node.declare_parameter(name, getattr(self.settings, name), descriptor(spec), ignore_override=True)
        node.add_pre_set_parameters_callback(self._before)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._after)

    def _before(self, proposed: list[Parameter]) -> list[Parameter]:
        """Convert integers to doubles, and log all invalid values. rclpy reports only the first invalid value."""
        problems = parameters.problems({parameter.name: parameter.value for parameter in proposed})
        if problems:
            self._node.get_logger().warning(str(parameters.ParameterError(problems, "parameters refused")))
        return [_converted(parameter) for parameter in proposed]

    def _check(self, proposed: list[Parameter]) -> SetParametersResult:
        values = {parameter.name: parameter.value for parameter in proposed}
        reasons = [str(problem) for problem in parameters.problems(values)]
        if not self._unconfigured():
            # an unchanged value is accepted, because a parameter file may set all parameters
            reasons += [
                f"{name}: takes effect {Effect.CONFIGURE.value}"
                for name, value in values.items()
                if name in SPECS
                and SPECS[name].metadata["effect"] is Effect.CONFIGURE
                and parameters.coerce(name, value) != getattr(self.settings, name)
            ]
            if values.get("use_sim_time", self._sim_time()) != self._sim_time():
                reasons.append(f"use_sim_time: takes effect {Effect.CONFIGURE.value}")
        if not reasons:
            checked = {name: parameters.coerce(name, value) for name, value in values.items() if name in SPECS}
            after = replace(self.settings, **checked)
            reasons += refused_changes(self.settings, after) or self._refusals(after)
        return SetParametersResult(successful=not reasons, reason="; ".join(reasons))

    def _sim_time(self) -> bool:
        return bool(self._node.get_parameter("use_sim_time").value)

    def _after(self, changed: list[Parameter]) -> None:
        values = {
            parameter.name: parameters.coerce(parameter.name, parameter.value)
            for parameter in changed
            if parameter.name in SPECS
        }
        self.settings = replace(self.settings, **values)
        for name, value in values.items():
            if SPECS[name].metadata["effect"] is Effect.NOW:
                self._changed(name, value)
