"""The command `plow-twin telemetry`, which sends the results of a node, and the options that define the receivers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from plow_twin.cli.console import DONE, DONE_WITH_LOSS, say_error
from plow_twin.cli.options import FILE, POSITIVE, combined, find_ros_wheels, node_options, wait_option

if TYPE_CHECKING:
    from plow_twin.telemetry.access import OutputSpec


#: Options for the receivers of results.
telemetry_options = combined(
    click.option("--mqtt-out", metavar="URL", help="Send results as JSON to mqtt[s]://HOST:PORT/PREFIX (extra mqtt)."),
    click.option(
        "--sparkplug",
        metavar="GROUP/NODE",
        default="",
        help="Send results to the broker of --mqtt-out as this Sparkplug B edge node (extra sparkplug).",
    ),
    click.option(
        "--influx", metavar="URL", help="Send results to InfluxDB, http[s]://HOST:PORT/ORG/BUCKET (extra influx)."
    ),
    click.option(
        "--opcua", metavar="URL", help="Serve results to OPC UA clients at opc.tcp://HOST:PORT (extra opcua)."
    ),
    click.option("--opcua-acknowledge", is_flag=True, help="Allow clients of --opcua to acknowledge alarms."),
    click.option(
        "--out-rate",
        type=POSITIVE,
        default=1.0,
        show_default=True,
        help="Rate of the updates [Hz]; peaks are those since the previous update.",
    ),
    click.option(
        "--out-access", type=FILE, help="YAML file with users, certificates and secret files for the receivers."
    ),
)


def outputs_of(options: dict[str, Any]) -> list[OutputSpec]:
    """Return the receivers that the options request."""
    if options["sparkplug"] and not options["mqtt_out"]:
        raise click.UsageError("--sparkplug: expected --mqtt-out with the broker")
    if not any(options[name] for name in ("mqtt_out", "influx", "opcua")):
        return []
    from plow_twin.telemetry import access

    credentials, plain = access.Credentials.read(options["out_access"]), options["plain"]
    outputs = []
    if options["mqtt_out"]:
        outputs += access.mqtt_out(options["mqtt_out"], credentials, plain=plain, sparkplug=options["sparkplug"])
    if options["influx"]:
        outputs.append(access.influx_out(options["influx"], credentials, plain=plain))
    if options["opcua"]:
        acknowledges = options["opcua_acknowledge"]
        outputs.append(access.opcua_out(options["opcua"], credentials, plain=plain, acknowledges=acknowledges))
    return outputs


@click.command(
    short_help="Send the results of a node to MQTT, Sparkplug, InfluxDB or OPC UA.",
    epilog="Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done, but messages were lost.",
)
@node_options
@wait_option("Time to wait for the node [s].")
@click.option("--plain", is_flag=True, help="Allow receivers on other machines without encryption.")
@telemetry_options
def telemetry(namespace: str, name: str, scene: str | None, wait: float, **options: Any) -> int:
    """Send the results of a running node until interrupted. The results are read from the topics of the node."""
    outputs = outputs_of(options)
    if not outputs:
        raise click.UsageError("expected --mqtt-out, --influx or --opcua")
    from plow_twin.live.stop import StopRequested, StopSignals

    with StopSignals() as stop:
        find_ros_wheels()
        from plow_twin.telemetry.node import send_node

        def on_error(text: str) -> None:
            say_error(f"plow-twin: {text}")

        def stopped() -> bool:
            stop.interrupt = False
            return stop.stopped

        try:
            lost = send_node(namespace, name, scene, outputs, options["out_rate"], wait, stopped, on_error)
        except StopRequested:
            return DONE
    return DONE_WITH_LOSS if lost else DONE
