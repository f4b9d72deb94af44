"""The command group, which runs the verbs and converts errors to exit codes."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Sequence
from io import TextIOWrapper
from typing import Final, NoReturn

import click

from plow_twin.build import package_version
from plow_twin.cli.analyse import analyse
from plow_twin.cli.call import call
from plow_twin.cli.compare import compare
from plow_twin.cli.console import FAILED, WRONG_INPUT, say_error
from plow_twin.cli.dashboard import dashboard
from plow_twin.cli.demo import demo
from plow_twin.cli.doctor import doctor
from plow_twin.cli.estimate import estimate
from plow_twin.cli.export import export
from plow_twin.cli.forecast import forecast
from plow_twin.cli.info import info
from plow_twin.cli.live import live
from plow_twin.cli.record import record
from plow_twin.cli.replay import replay
from plow_twin.cli.setup import setup
from plow_twin.cli.simulate import simulate
from plow_twin.cli.study import study
from plow_twin.cli.telemetry import telemetry
from plow_twin.cli.view import view
from plow_twin.errors import ExcessError, InputError, PlowTwinError, RunInterrupted, UnitError

#: Extra of the package that must be installed for each optional module.
EXTRA_OF_MODULE: Final = {
    module: extra
    for extra, modules in {
        "ros": "rclpy rcl_interfaces builtin_interfaces diagnostic_msgs geometry_msgs lifecycle_msgs nav_msgs "
        "rosgraph_msgs sensor_msgs std_msgs std_srvs visualization_msgs",
        "record": "mcap rosbags",
        "mqtt": "paho",
        "opcua": "asyncua",
        "sparkplug": "google",
        "influx": "influxdb_client",
        "metrics": "prometheus_client",
        "dashboard": "starlette uvicorn websockets",
        "view": "rerun",
        "study": "rainflow matplotlib pandas pyarrow jinja2",
        "dask": "distributed",
    }.items()
    for module in modules.split()
}

#: Largest length of an error message [characters]. A message may list all names in a file.
_LONGEST: Final = 16_000


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss.",
)
@click.version_option(package_version(), "-V", "--version", prog_name="plow-twin")
@click.option(
    "--laws",
    multiple=True,
    metavar="MODULE",
    help="Python file or module that adds contact laws (plow_twin.add_law). Its code is executed. May be repeated.",
)
def commands(laws: tuple[str, ...]) -> None:
    """Digital twin of a coal plough head: contact-impact motion in its guide."""
    if laws:
        from plow_twin.model.law_modules import load_laws

        load_laws(laws)


for _verb in (
    simulate, demo, setup, live, call, dashboard, telemetry, estimate, forecast, record, replay, analyse, compare,
    export, doctor, view, info, study,
):  # fmt: skip
    commands.add_command(_verb)


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line, and exit with its exit code."""
    # in the locale C, a name or the ellipsis of a table cannot be encoded
    if isinstance(sys.stdout, TextIOWrapper) and sys.stdout.encoding.lower() != "utf-8":
        sys.stdout.reconfigure(errors="backslashreplace")
    code = run(arguments)
    if threading.current_thread() is threading.main_thread():
        # a terminal and `ros2 launch` may both send a signal, and the second signal would change the exit code
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
    try:
        if sys.stdout is not None:  # standard output is None if it was closed at the start
            sys.stdout.flush()
    except BrokenPipeError:
        # standard output is replaced, so that Python does not report a broken pipe at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run the command line, and return its exit code. An error is printed as a message on standard error."""
    try:
        code = commands.main(args=arguments, prog_name="plow-twin", standalone_mode=False)
        return code if isinstance(code, int) else 0
    except click.ClickException as error:
        hint = error.ctx.get_usage() + "\n" if isinstance(error, click.UsageError) and error.ctx else ""
        say_error(f"{hint}Error: {error.format_message()}")
        return error.exit_code
    except RunInterrupted as error:
        return _fail(str(error))
    except (click.Abort, KeyboardInterrupt) as error:
        # click replaces a KeyboardInterrupt or an EOFError by an Abort with this cause; a prompt's Abort has no cause
        stopped = error.__cause__
        if isinstance(stopped, EOFError):
            raise stopped from None
        return _fail(str(stopped) if isinstance(stopped, RunInterrupted) else "interrupted")
    except (InputError, UnitError, ExcessError) as error:
        return _fail(str(error), WRONG_INPUT)
    except PlowTwinError as error:
        return _fail(str(error))
    except BrokenPipeError:
        return FAILED
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except MemoryError as error:
        return _fail(f"not enough memory: {error}" if str(error) else "not enough memory")
    except ModuleNotFoundError as error:
        module = (error.name or "").partition(".")[0]
        if module not in EXTRA_OF_MODULE:
            raise
        extra = EXTRA_OF_MODULE[module]
        return _fail(f"this verb needs {module}, which is not installed: pip install 'plow_twin[{extra}]'")


def _fail(message: str, code: int = FAILED) -> int:
    if len(message) > _LONGEST:
        message = f"{message[:_LONGEST]} ... ({len(message)} characters)"
    say_error(f"plow-twin: {message}")
    return code
