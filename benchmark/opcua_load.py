"""`plow-twin live` with an OPC UA server that writes three values at 1 kHz: loss, share of a core, and age.

`python benchmark/live_load.py --opcua [--minutes 10]` first connects a bare asyncua client for a tenth of the time, to
measure the part of the age that the server and the connection cause. Both processes request SCHED_FIFO, so that other
programs do not delay them.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from live_load import ROOT, account, cpu_s, quantiles

NODES = ("Load.Fx", "Load.Fy", "Load.M")
NAMESPACE = 2
#: Publishing interval [ms] and queue length. Bare client and twin request the same values.
PUBLISHING_MS, QUEUE = 10.0, 10_000
#: Time [s] without a value after which the bare client ends.
SILENCE_S = 3.0
MAP = "excitation: {fx: {node: ns=2;s=Load.Fx}, fy: {node: ns=2;s=Load.Fy}, m: {node: ns=2;s=Load.M}}\n"
#: Targets: largest 99th percentile of the age [ms], and largest share of a core.
MOST_AGE_MS, MOST_CORE = 15.0, 0.5


def at_once() -> bool:
    """Request SCHED_FIFO. Return whether the system grants it."""
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
        return True
    return False


async def serve(port: int, rate_hz: float, seconds: float) -> None:
    """Serve three nodes. When a client subscribes, write values whose stamps are the time of writing."""
    from asyncua import ua
    from asyncua.server.server import Server
    from asyncua.ua.status_codes import StatusCodes

    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/plant")
    assert await server.register_namespace("urn:plow-twin:benchmark") == NAMESPACE
    add = server.nodes.objects.add_variable
    nodes = [
        await add(ua.NodeId.from_string(f"ns={NAMESPACE};s={name}"), name, 0.0, ua.VariantType.Double) for name in NODES
    ]
    subscriptions = server.iserver.subscription_service.subscriptions
    good = ua.StatusCode(ua.UInt32(StatusCodes.Good))
    async with server:
        print("ready", flush=True)
        while not any(subscription.monitored_item_srv._monitored_items for subscription in subscriptions.values()):
            await asyncio.sleep(0.05)
        await asyncio.sleep(3.0)
        begin = time.monotonic()
        for index in range(round(rate_hz * seconds)):
            wait_s = begin + index / rate_hz - time.monotonic()
            await asyncio.sleep(max(0.0, wait_s))
            now: Any = datetime.now(UTC)
            phase = 0.001 * index
            for node, amplitude in zip(nodes, (30_000.0, 10_000.0, 2_000.0), strict=True):
                value = ua.Variant(amplitude * math.sin(phase + amplitude), ua.VariantType.Double)
                await node.write_value(ua.DataValue(value, good, now, now))
        print("written", flush=True)
        await asyncio.to_thread(sys.stdin.readline)


async def hear(port: int) -> None:
    """Print the number of values that a bare client receives, and their age."""
    from asyncua import ua
    from asyncua.client.client import Client

    ages: list[float] = []

    class Heard:
        def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
            ages.append((datetime.now(UTC) - data.monitored_item.Value.SourceTimestamp).total_seconds() * 1e3)

    async with Client(f"opc.tcp://127.0.0.1:{port}/plant") as client:
        subscription = await client.create_subscription(PUBLISHING_MS, Heard())
        nodes = [client.get_node(ua.NodeId.from_string(f"ns={NAMESPACE};s={name}")) for name in NODES]
        await subscription.subscribe_data_change(nodes, queuesize=QUEUE, sampling_interval=ua.Double(0.0))
        count = -1
        while len(ages) != count or count <= len(NODES):
            count = len(ages)
            await asyncio.sleep(SILENCE_S)
    ordered = ages[len(NODES) :]
    print(json.dumps({"values": len(ordered)} | quantiles(ordered)))


def measure(minutes: float, rate_hz: float) -> bool:
    """Print the results of the bare client and of the twin. Return whether each sample was used or counted."""
    seconds = 60.0 * minutes
    with _server(rate_hz, 0.1 * seconds) as (_, port):
        bare = subprocess.run(
            [sys.executable, __file__, "hear", str(port)], check=True, capture_output=True, text=True, cwd=ROOT
        )
    print(f"bare client: {bare.stdout.strip()}", flush=True)
    with tempfile.TemporaryDirectory() as folder, _server(rate_hz, seconds) as (server, port):
        report, load = _live(Path(folder), server, port, rate_hz, seconds)
    print(f"twin: {json.dumps(report)}", flush=True)
    print(f"mean load of the machine beside them {load:.2f} of {os.cpu_count()} cores, SCHED_FIFO granted: {at_once()}")
    sent = round(rate_hz * seconds)
    unaccounted = sent - sum(report[key] for key in ("used", "dropped", "lost"))
    for text, reached, most in (
        ("samples not accounted for", unaccounted, 0),
        ("age at the twin, 99 % [ms]", report["age_p99_ms"], MOST_AGE_MS),
        ("share of a core, client and twin", report["core"], MOST_CORE),
    ):
        print(f"{'reached' if reached <= most else 'MISSED '} {reached:g} of {most:g}: {text}", flush=True)
    return unaccounted == 0


def _live(
    folder: Path, server: subprocess.Popen[str], port: int, rate_hz: float, seconds: float
) -> tuple[dict[str, float], float]:
    """Run the twin until the server has written all values. Return its figures, and the load by other programs."""
    (folder / "map.yaml").write_text(MAP)
    settings = [word for text in ("priority=10", f"expected_rate={rate_hz}") for word in ("--set", text)]
    twin = subprocess.Popen(
        [sys.executable, "-m", "plow_twin", "live", f"opc.tcp://127.0.0.1:{port}/plant", "--map", "map.yaml",
         "--scene", "paper", "--record", "run", "--json", *settings],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert server.stdout is not None and twin.stdout is not None
    time.sleep(0.2 * seconds)  # the start is not measured
    begin, busy, machine = time.monotonic(), cpu_s(twin.pid), _machine_s() - cpu_s(server.pid)
    time.sleep(0.6 * seconds)
    passed_s, used_s = time.monotonic() - begin, cpu_s(twin.pid) - busy
    load = (_machine_s() - cpu_s(server.pid) - machine - used_s) / passed_s
    assert server.stdout.readline() == "written\n"
    time.sleep(SILENCE_S)
    twin.terminate()
    parts = json.loads(twin.communicate()[0])
    counts, source = parts["input"], parts["source"]
    return {
        "sent": round(rate_hz * seconds),
        **account(counts),
        "values": int(float(source["values"])),
        "notifications_lost": int(source["notifications_lost"]),
        "overflows": int(source["overflows"]),
        "core": round(used_s / passed_s, 3),
        "age_p50_ms": float(parts["output"]["age_p50_ms"]),
        "age_p99_ms": float(parts["output"]["age_p99_ms"]),
    }, load


@contextmanager
def _server(rate_hz: float, seconds: float) -> Iterator[tuple[subprocess.Popen[str], int]]:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = int(found.getsockname()[1])
    process = subprocess.Popen(
        [sys.executable, __file__, "serve", str(port), str(rate_hz), str(seconds)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        yield process, port
    finally:
        process.kill()
        process.communicate()


def _machine_s() -> float:
    """Return the busy time of all processors [s]."""
    fields = list(map(int, Path("/proc/stat").read_text().splitlines()[0].split()[1:9]))
    return (sum(fields) - fields[3] - fields[4]) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    role, port, *numbers = sys.argv[1:]
    at_once()
    logging.disable()
    asyncio.run(serve(int(port), *map(float, numbers)) if role == "serve" else hear(int(port)))


if __name__ == "__main__":
    main()
