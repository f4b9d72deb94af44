"""The process of one output, which is started by `python -m plow_twin.telemetry.process LINK`.

The first message on the link contains the description of the output. While the receiver does not answer, updates are
queued. If the queue is full, updates are dropped and counted, so that the twin is never delayed.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import asdict
from importlib import import_module
from typing import Any, Final

from plow_twin.dashboard.beside import join_twin
from plow_twin.dashboard.link import Link
from plow_twin.errors import PlowTwinError
from plow_twin.telemetry.output import Output
from plow_twin.telemetry.values import Newest

OUTPUTS: Final = {
    "mqtt": ("plow_twin.telemetry.mqtt", "MqttOut"),
    "sparkplug": ("plow_twin.telemetry.sparkplug", "Sparkplug"),
    "influx": ("plow_twin.telemetry.influx", "Influx"),
    "opcua": ("plow_twin.telemetry.opcua.server", "OpcUaServer"),
}
#: Increment of `nice`, so that the twin has priority.
_NICE: Final = 5
#: Longest time between two checks of the state of the output [s]. Changes of the state are reported.
_REPORT_S: Final = 0.5
#: Time in which the receiver can take the queued messages at the end [s].
_END_S: Final = 2.0


def _report(output: Output) -> dict[str, Any]:
    return {"do": "report", **asdict(output.state)}


async def serve(link: Link, output: Output, newest: Newest) -> None:
    """Pass updates to the output until the twin requests the end, or has ended."""
    sent, ends = _report(output), False
    link.send(sent)
    while not (ends or link.broken):
        await _readable(link)
        while not ends and (update := link.receive()) is not None:
            ends = "end" in update
            if not ends:
                await output.send(newest.update(update), newest)
        await output.turn()
        report = _report(output)
        if report != sent and link.send(report):
            sent = report
    await output.close(0.0 if link.broken else _END_S)
    link.send(_report(output))


async def _readable(link: Link) -> None:
    loop, readable = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(link.fileno(), readable.set)
    with suppress(TimeoutError):
        await asyncio.wait_for(readable.wait(), _REPORT_S)
    loop.remove_reader(link.fileno())


async def _run(link: Link, first: dict[str, Any]) -> None:
    module, name = OUTPUTS[first.pop("output")]
    newest = Newest()
    newest.update({"facts": first.pop("facts")})
    try:
        output: Output = getattr(import_module(module), name)(**first)
        await output.open(link, newest)
    except PlowTwinError as error:
        link.send({"do": "report", "failed": str(error)})
        return
    await serve(link, output, newest)


def main() -> None:
    """Serve an output over the link, whose file descriptor is the argument."""
    asyncio.run(_run(*join_twin(_NICE)))


if __name__ == "__main__":
    main()
