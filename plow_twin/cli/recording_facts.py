"""Summarize the content of a recording, the state of its end, and its losses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from plow_twin.record.reader import FileStatus, RunReader
from plow_twin.record.run_time import RunTime
from plow_twin.record.unused import InputCounts
from plow_twin.stream.journal import Failed


def read_recording(path: Path) -> tuple[dict[str, Any], bool]:
    """Return a summary of a recording, and whether it is incomplete or has losses or failed advances.

    Raises
    ------
    RecordingError
        The file is not a recording of plow_twin.
    """
    reader = RunReader(path)
    inputs, failed = InputCounts(reader.header.excitation_source), 0
    run_time = RunTime(reader.header.parameters)
    for batch in reader.batches():
        inputs.add(batch.entries)
        run_time.add(batch.entries)
        failed += sum(entry.advances for entry in batch.entries.rest.values() if isinstance(entry, Failed))
    header = reader.header
    facts: dict[str, Any] = {
        "file": str(reader.path),
        "status": reader.status.value,
        "stop_reason": reader.stop_reason,
        "duration_s": run_time.span_s,
        "without_samples": run_time.silences.facts(),
        "messages": dict(sorted(reader.counts.items())),
        "inputs": inputs.facts(),
        "failed_advances": failed,
        "lost": {**reader.lost, **reader.lost_parts},
        "damaged_chunks": reader.damaged_chunks,
        "foreign_parts": {file.name: list(keys) for file, keys in reader.foreign.items()},
        "run_id": header.run_id,
        "package_version": header.package_version,
        "node": header.node,
        "excitation_source": header.excitation_source,
        "tol": header.tol,
        "clock": header.clock,
        "origin_ns": header.origin_ns,
        "build": dict(header.build),
        "parameters": dict(header.parameters),
    }
    return facts, bool(facts["lost"] or failed) or reader.status is not FileStatus.COMPLETE
