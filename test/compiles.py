"""Plugin for `pytest --compiles`: it lists the kernels that tests compile, with processor time and first test.

A kernel that several tests use is compiled by the first of them. Kernels of child processes are not listed.
"""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import pytest
from numba.core import event

PROPERTY = "compiled"


class Compiles(event.Listener):
    """Record each kernel that Python calls in the report of the test that compiles it."""

    def __init__(self) -> None:
        self._test: list[tuple[str, object]] = []
        self._begun: list[float] = []
        self._found: list[tuple[float, str, str]] = []
        event.register("numba:compile", self)

    def on_start(self, event: Any) -> None:
        self._begun.append(time.thread_time())

    def on_end(self, event: Any) -> None:
        took = time.thread_time() - self._begun.pop()
        if not self._begun:  # the time of a kernel includes the kernels that are compiled for it
            function = event.data["dispatcher"].py_func
            self._test.append((PROPERTY, (took, f"{function.__module__}.{function.__qualname__}")))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        self._test = item.user_properties

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":  # only the last report of a test contains all its kernels
            for name, value in report.user_properties:
                if name == PROPERTY:
                    self._found.append((*value, report.nodeid))  # type: ignore[misc]

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        kernels: dict[str, list[float]] = defaultdict(list)
        terminalreporter.section("compiled kernels")
        for seconds, kernel, nodeid in sorted(self._found, reverse=True):
            kernels[kernel].append(seconds)
            if seconds >= 1.0:
                terminalreporter.write_line(f"{seconds:6.1f} s  {kernel}  {nodeid}")
        for kernel, times in sorted(kernels.items(), key=lambda item: -sum(item[1])):
            terminalreporter.write_line(f"{sum(times):6.1f} s  {len(times):4} times  {kernel}")
