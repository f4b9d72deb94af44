"""A real MQTT broker for a separate process: `python mqtt_broker.py CONFIG.yaml`."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

import yaml
from amqtt.broker import Broker


async def serve() -> None:
    broker = Broker(yaml.safe_load(Path(sys.argv[1]).read_text()))
    await broker.start()
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve())
