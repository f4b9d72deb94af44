"""The command `plow-twin live`, which runs the live twin without ROS."""

from __future__ import annotations

import json
import re
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from plow_twin.cli.console import (
    DONE,
    DONE_WITH_LOSS,
    busy,
    error_console,
    output_console,
    progress_bar,
    say_error,
    show_facts,
)
from plow_twin.cli.dashboard import access_if_shown, access_options, dashboard_option, say_where, stay
from plow_twin.cli.live_report import Report
from plow_twin.cli.options import (
    FILE,
    FOLDER,
    PLACE,
    POSITIVE,
    json_option,
    map_option,
    named_option,
    quiet_option,
    unit_option,
)
from plow_twin.cli.telemetry import outputs_of, telemetry_options

if TYPE_CHECKING:
    from plow_twin.live.bridge.access import Access
    from plow_twin.live.bridge.source import Bridge
    from plow_twin.live.front import BridgeFront
    from plow_twin.live.parameters import Settings
    from plow_twin.live.stop import StopSignals

_PROGRESS_S = 0.2
#: Pattern of the names of counters that count unused messages.
_LOST = re.compile(r"dropped_.*|.*_dropped|.*_lost")


@click.command(
    short_help="Run the twin on CSV or Parquet files, standard input, MQTT or OPC UA.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage or scene, 3 done with counted loss.",
)
@click.argument("source")
@click.option("--scene", help="Scene file or preset; by default the parameter `scene`.")
@map_option
@unit_option
@click.option("--params", type=FILE, help="YAML file with parameters, in the form of a parameter file of the node.")
@named_option("--set", "given", "NAME=VALUE", "Value of a parameter; may be repeated.")
@click.option("--record", type=FOLDER, help="Folder for the recording.")
@click.option("--follow", is_flag=True, help="Continue while the files grow.")
@click.option(
    "--seconds",
    type=POSITIVE,
    default=None,
    help="Time after the start of the twin [s] at which it stops, even without samples.",
)
@click.option(
    "--user",
    default="",
    help="User at the broker or server. The password is in --password-file, PLOW_TWIN_MQTT_PASSWORD or "
    "PLOW_TWIN_OPCUA_PASSWORD.",
)
@click.option("--password-file", type=FILE, help="File whose first line is the password.")
@click.option("--user-cert", type=FILE, help="Certificate of the user at an OPC UA server, instead of --user.")
@click.option("--user-key", type=FILE, help="Private key of --user-cert.")
@click.option("--tls-ca", type=FILE, help="Authority that issued the certificate of the broker or server.")
@click.option("--tls-cert", type=FILE, help="Certificate of this client.")
@click.option("--tls-key", type=FILE, help="Private key of --tls-cert.")
@click.option(
    "--client-id", default="plow_twin", show_default=True, help="Client name for which the broker stores messages."
)
@click.option("--plain", is_flag=True, help="Allow brokers and servers on other machines without encryption.")
@click.option("--lines", is_flag=True, help="Print status, alarms and diagnostics as JSON lines on standard output.")
@click.option("--control", type=PLACE, help="Socket to open for `plow-twin call`.")
@click.option(
    "--metrics", type=click.IntRange(1, 65535), help="Serve the diagnostics to Prometheus on this port of this machine."
)
@telemetry_options
@dashboard_option
@access_options
@json_option
@quiet_option
def live(source: str, **options: Any) -> int:
    """Run the twin on the samples of SOURCE.

    SOURCE is a CSV or Parquet file, a folder of CSV or Parquet files, - (standard input), mqtt[s]://HOST:PORT or
    opc.tcp://HOST:PORT.
    """
    from plow_twin.live.stop import StopRequested, StopSignals

    with StopSignals() as stop:
        try:
            return _live(source, stop, options)
        except StopRequested:
            from plow_twin.live.solver_start import leave

            return leave(DONE)


def _live(source: str, stop: StopSignals, options: dict[str, Any]) -> int:
    from plow_twin.dashboard.live import open_screen
    from plow_twin.live.bridge.files import Files
    from plow_twin.live.control import TURN_S, Control
    from plow_twin.live.front import BridgeFront
    from plow_twin.live.realtime import apply_realtime, raise_priority
    from plow_twin.live.services import Services
    from plow_twin.live.solver_start import Preparation, leave
    from plow_twin.live.timer import Timer
    from plow_twin.telemetry.live import open_output

    as_json, quiet, lines = (bool(options[name]) for name in ("as_json", "quiet", "lines"))
    report = Report(lines=lines, quiet=quiet, stamp_ns=lambda: front.runtime.stamp_ns)
    settings = _settings(options)
    access = access_if_shown(options)
    outputs = outputs_of(options)
    bridge = _bridge(source, options, settings.expected_rate)
    for refused in (*apply_realtime(settings), *raise_priority(settings)):
        say_error(f"plow-twin: refused by the system: {refused}")
    with busy("preparing the solver", quiet or not error_console().is_terminal):
        prepared = Preparation(settings).result(lambda: stop.stopped)

    with report, closing(bridge), ExitStack() as opened:
        control = opened.enter_context(Control(options["control"])) if options["control"] else None
        front = BridgeFront(bridge, options["mapping"], settings, prepared, report.say, report.error, options["units"])
        _say_what_differs(front, settings)
        if options["metrics"]:
            from plow_twin.live.metrics import Metrics

            front.attach(opened.enter_context(Metrics(options["metrics"], front.parts())))
        if control is not None:
            control.services = Services(front.runtime, front.changed)
            front.timers.append(Timer(TURN_S, control.turn))
        screen = None
        if access is not None:
            screen = opened.enter_context(open_screen(front, access, source))
            say_where(screen, access)
        for output in outputs:
            opened.enter_context(open_output(front, output, options["out_rate"], source))
        if isinstance(bridge, Files) and bridge.ends:
            _say_pace(settings, quiet)
            update = opened.enter_context(progress_bar("reading", quiet or lines))
            front.timers.append(Timer(_PROGRESS_S, lambda: update(bridge.share)))
        stop.interrupt = False
        lost = front.run(lambda: stop.stopped, options["seconds"] or float("inf"))
        if screen is not None and bridge.finished and not stop.stopped:
            stay(screen, lambda: stop.stopped)
    parts = front.parts()
    facts = {name: values for name, (_, _, values) in parts.items()}
    closed = report.close_lines()
    if report.lost:
        lost = [*lost, f"{report.lost} lines were not, or only partly, written to standard output"]
    for text in (*lost, *front.causes()):
        report.error(text)
    hangs = not report.close() or not closed
    if as_json and closed:
        click.echo(json.dumps(facts, indent=2))
    elif not quiet and not lines:
        shown = {key: value for key, value in facts["input"].items() if value not in ("", "0") or key == "samples_used"}
        show_facts(output_console(), {"input": shown})
        _show_estimate(front)
    unused = any(int(facts["input"][key]) for key in facts["input"] if _LOST.fullmatch(key))
    code = DONE_WITH_LOSS if lost or unused or facts["recorder"]["lost"] else DONE
    return leave(code, at_once=hangs)


def _say_what_differs(front: BridgeFront, settings: Settings) -> None:
    from plow_twin.record.unit_check import small_thresholds

    recording = front.runtime.recording
    if recording is not None and (folder := recording.recorder.path.parent) != Path(settings.record_path):
        say_error(f"plow-twin: {settings.record_path} is not empty: the recording is written to {folder}")
    doubt = small_thresholds(settings.alarm_force, front.runtime.scene)
    if doubt:
        say_error(f"plow-twin: {doubt}")


def _say_pace(settings: Settings, quiet: bool) -> None:
    if settings.follows == "full" and not quiet:
        say_error(
            f"plow-twin: {settings.follow_members} twins follow the machine, which takes about as long as the "
            "measurement of the file; --set follow=parameters is faster, but gives no intervals of the forces"
        )


def _show_estimate(front: BridgeFront) -> None:
    estimation = front.runtime.estimation
    if estimation is None or estimation.entry is None:
        return
    from plow_twin.cli.estimate import show_estimate
    from plow_twin.estimate.result import Estimate

    show_estimate(Estimate.from_dict(json.loads(estimation.entry.result)), front.runtime.scene)


def _settings(options: dict[str, Any]) -> Settings:
    """Return the parameters from the file, the option `--set` and the specific options, in ascending priority."""
    from plow_twin.live import parameters

    values = parameters.read_parameters(options["params"]) if options["params"] else {}
    values |= {name.strip(): parameters.read_value(value) for name, value in options["given"].items()}
    for name, nearest in parameters.unknown(values):
        hint = f"; did you mean {nearest}?" if nearest else ""
        raise click.BadParameter(f"unknown parameter {name}{hint}", param_hint="--set or --params")
    try:
        settings = parameters.settings(values)
    except parameters.ParameterError as error:
        raise click.UsageError(str(error)) from error
    if not options["scene"] and "scene" not in values:
        say_error(f"plow-twin: no --scene: the preset {settings.scene} is used, which is not your machine")
    if settings.opcua_server:
        raise click.UsageError("opcua_server: got a parameter that only the node has, expected the address as SOURCE")
    scene, record = options["scene"] or settings.scene, options["record"] or settings.record_path
    return replace(settings, scene=scene, record_path=str(record))


def _bridge(source: str, options: dict[str, Any], rate_hz: float) -> Bridge:
    from plow_twin.live.bridge.files import Files, StandardInput
    from plow_twin.live.bridge.source import BridgeError

    if "://" in source:
        from plow_twin.access import secret
        from plow_twin.live.bridge.access import Access

        opcua = source.startswith("opc.tcp://")
        access = Access(
            source,
            user=options["user"],
            password=secret(options["password_file"], "OPCUA_PASSWORD" if opcua else "MQTT_PASSWORD"),
            ca=options["tls_ca"],
            certificate=options["tls_cert"],
            key=options["tls_key"],
            user_certificate=options["user_cert"],
            user_key=options["user_key"],
            plain=options["plain"],
            client_id=options["client_id"],
        )
        if opcua:
            return _opcua(access, options["mapping"], rate_hz)
        from plow_twin.live.bridge.mqtt import Mqtt

        return Mqtt(access)
    if source == "-":
        return StandardInput()
    path = Path(source)
    paths = _tables(path, growing=options["follow"]) if path.is_dir() else [path]
    if not paths:
        kinds = ".csv" if options["follow"] else ".csv or .parquet"
        raise BridgeError(f"{path}: got a folder without {kinds}, expected at least one file")
    files = Files(paths, follow=options["follow"])
    page = "; the page opens after it, and its address is then printed" if options["dashboard"] else ""
    for missing in files.awaited() if options["follow"] else ():
        say_error(f"plow-twin: {missing}: waiting for its first line{page}")
    return files


def _tables(folder: Path, *, growing: bool) -> list[Path]:
    """Return the tables in a folder, without Parquet files if the tables are growing."""
    from plow_twin.scene_file.csv_rows import tables
    from plow_twin.scene_file.parquet_lines import is_parquet

    return [path for path in tables(folder) if not (growing and is_parquet(path))]


def _opcua(access: Access, mapping: Path | None, rate_hz: float) -> Bridge:
    from plow_twin.live.bridge.opcua.bridge import OpcUa
    from plow_twin.live.bridge.source import BridgeError
    from plow_twin.record.mapping import read_map

    if mapping is None:
        raise BridgeError("got no mapping, expected --map with the nodes: excitation: {fx: {node: 'ns=2;s=...'}, ...}")
    return OpcUa(access, read_map(mapping, None), rate_hz)
