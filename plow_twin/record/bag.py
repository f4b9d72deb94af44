"""Write messages of arbitrary topics, as bytes, to an MCAP file in a folder of a run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from plow_twin.build import package_version
from plow_twin.record.chunks import is_mcap
from plow_twin.record.mcap_file import ChunkBuilder, McapFile, UnbufferedFile
from plow_twin.record.metadata_yaml import PartFacts, TopicCount, bag_metadata, recorded_losses, write_metadata
from plow_twin.record.writer import BESIDE, make_folder, shortage

_CHUNK_SIZE: Final = 2**20
_MIN_FREE_BYTES: Final = 64 * 1024 * 1024


@dataclass(frozen=True)
class Topic:
    """A topic with its message type, the `ros2msg` text and REP-2016 hash of the type, and the offered QoS in YAML."""

    name: str
    message_type: str
    schema: str
    type_hash: str
    qos: str


class BagWriter:
    """Write messages to an MCAP file in a new folder.

    If the process is killed, the messages since the last `flush` are lost. The attribute `lost` contains, for each
    topic, the number of messages that did not fit on the disk. The function `on_trouble` receives a text when the disk
    becomes full, and a text at the first successful write after that. Raise `RecordingError` if the folder cannot be
    created.
    """

    def __init__(self, folder: Path, on_trouble: Callable[[str], object] = lambda text: None) -> None:
        make_folder(folder)
        self.folder = folder
        self.path = folder / f"{folder.name}_0.mcap"
        self._file = McapFile(UnbufferedFile(self.path), f"plow_twin {package_version()}")
        self._chunk = ChunkBuilder("zstd")
        self._topics: dict[int, Topic] = {}
        self._waiting: Counter[str] = Counter()
        self.written: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        self.error = ""
        self._on_trouble, self._in_trouble = on_trouble, False

    def topic(self, topic: Topic) -> int:
        """Register a topic and return its number."""
        metadata = {"offered_qos_profiles": topic.qos, "topic_type_hash": topic.type_hash}
        number = self._file.channel(topic.name, topic.message_type, topic.schema.encode(), metadata)
        self._topics[number] = topic
        return number

    def add(self, number: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Write one message of a topic."""
        times = (max(0, log_time_ns), max(0, publish_time_ns))
        self._chunk.add(number, sequence & 0xFFFFFFFF, *times, data)
        self._waiting[self._topics[number].name] += 1
        if self._chunk.size >= _CHUNK_SIZE:
            self.flush()

    def flush(self) -> None:
        """Write the buffered messages to the file; if the disk is full, count the messages as lost."""
        waiting, self._waiting = self._waiting, Counter()
        try:
            short = shortage(self.folder, _MIN_FREE_BYTES) if waiting else None
            if short is not None:
                raise OSError(short)
            self._file.chunk(self._chunk)
        except OSError as error:  # the next flush tries to write again
            self._chunk.clear()
            self.lost.update(waiting)
            self.error = f"{self.path}: {error.strerror or error}"
            if not self._in_trouble:
                self._on_trouble(f"{self.error}: messages are lost until the disk has free space")
            self._in_trouble = True
        else:
            if waiting and self._in_trouble:
                self._on_trouble(f"{self.path}: recording continues, {sum(self.lost.values())} messages were lost")
                self._in_trouble = False
            self.written.update(waiting)

    def close(self) -> None:
        """Write the index of the file, close the file, and write `metadata.yaml`.

        Raise `OSError` if the disk is full. The file stays without an index.
        """
        self.flush()
        self._file.finish()
        self._file.out.close()
        counts = [
            TopicCount(topic.name, topic.message_type, self.written[topic.name], topic.qos, topic.type_hash)
            for topic in self._topics.values()
        ]
        write_metadata(self.folder, bag_metadata([PartFacts(self.path.name, *self._file.times, counts)], self.lost))


def beside_folders(run: Path) -> Sequence[Path]:
    """Return the subfolders of a run that contain the recordings of topics that do not belong to the twin."""
    return sorted(path for path in run.glob(f"{BESIDE}*") if path.is_dir() and any(path.glob("*.mcap")))


def readable_beside(run: Path, lost: Counter[str]) -> list[Path]:
    """Return the folders of `beside_folders` that contain a readable MCAP file.

    The counter `lost` receives the losses that the recorder counted, and the number of files in each unreadable folder.
    """
    folders = []
    for folder in beside_folders(run):
        lost.update(recorded_losses(folder))
        parts = [*folder.glob("*.mcap")]
        # if a folder can be read in part, its reader counts the unreadable files
        if any(map(is_mcap, parts)):
            folders.append(folder)
        else:
            lost.update("truncated_files" if is_mcap(part) is None else "damaged_files" for part in parts)
    return folders
