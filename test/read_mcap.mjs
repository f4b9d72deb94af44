// Read a recording with @mcap/core, by its index and without it: node read_mcap.mjs FILE; prints counts by topic as JSON.
import { readFile } from "node:fs/promises";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";

const data = new Uint8Array(await readFile(process.argv[2]));
const decompressHandlers = await loadDecompressHandlers();
const readable = {
  size: async () => BigInt(data.length),
  read: async (offset, length) => data.subarray(Number(offset), Number(offset + length)),
};
const indexed = await McapIndexedReader.Initialize({ readable, decompressHandlers });
const counts = {};
let last = 0n;
let inOrder = true;
for await (const message of indexed.readMessages()) {
  const { topic } = indexed.channelsById.get(message.channelId);
  counts[topic] = (counts[topic] ?? 0) + 1;
  inOrder &&= message.logTime >= last;
  last = message.logTime;
}
const stream = new McapStreamReader({ decompressHandlers, validateCrcs: true });
stream.append(data);
let streamed = 0;
for (let record; (record = stream.nextRecord()); ) streamed += record.type === "Message" ? 1 : 0;
const schemas = [...indexed.schemasById.values()].map(({ name, encoding }) => `${name} ${encoding}`).sort();
const metadata = indexed.metadataIndexes.map(({ name }) => name);
console.log(JSON.stringify({ counts, inOrder, streamed, done: stream.done(), schemas, metadata, profile: indexed.header.profile }));
