import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { FileHandleReadable } from "@mcap/nodejs";
import { open, readFile } from "node:fs/promises";
const path = process.argv[2];
const decompressHandlers = await loadDecompressHandlers();
const streamed = {};
const reader = new McapStreamReader({ validateCrcs: true, decompressHandlers });
reader.append(await readFile(path));
const topics = new Map();
for (let record; (record = reader.nextRecord()); ) {
  if (record.type === "Channel") topics.set(record.id, record.topic);
  if (record.type === "Message") { const t = topics.get(record.channelId); streamed[t] = (streamed[t] ?? 0) + 1; }
}
const indexed = {};
const handle = await open(path);
const mcap = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
for await (const message of mcap.readMessages({ validateCrcs: true })) {
  const t = mcap.channelsById.get(message.channelId).topic; indexed[t] = (indexed[t] ?? 0) + 1;
}
await handle.close();
console.log(JSON.stringify({ streamed, indexed, profile: mcap.header.profile }));
