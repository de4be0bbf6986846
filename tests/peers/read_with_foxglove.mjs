// Reads an MCAP file by its index as Foxglove's viewer does, decodes every message by the schema in the file, and holds
// its fields against Foxglove's published schema of that name. Prints one JSON object.
import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { open } from "node:fs/promises";
import { createRequire } from "node:module";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor/index.js";

const { foxgloveMessageSchemas } = createRequire(import.meta.url)("@foxglove/schemas/internal");
const handle = await open(process.argv[2]);
const readable = {
  size: async () => BigInt((await handle.stat()).size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    const { bytesRead } = await handle.read(buffer, 0, buffer.length, Number(offset));
    if (bytesRead !== buffer.length) throw new Error(`${bytesRead} bytes at ${offset}, not ${length}`);
    return buffer;
  },
};
const published = new Map(Object.values(foxgloveMessageSchemas).map((schema) => [`foxglove.${schema.name}`, schema]));
const plain = { longs: String, bytes: String, defaults: true };
const mcap = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
const types = new Map();
for (const schema of mcap.schemasById.values()) {
  if (schema.encoding !== "protobuf") throw new Error(`${schema.name}: ${schema.encoding}`);
  const root = protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data));
  types.set(schema.id, root.lookupType(schema.name));
}
const topics = {};
for await (const message of mcap.readMessages({ validateCrcs: true })) {
  const channel = mcap.channelsById.get(message.channelId);
  const schema = mcap.schemasById.get(channel.schemaId);
  const type = types.get(schema.id);
  const decoded = type.decode(message.data);
  const found = (topics[channel.topic] ??= {
    schema: schema.name,
    encoding: channel.messageEncoding,
    fields: type.fieldsArray.map((field) => protobuf.util.camelCase(field.name)).sort(),
    published: (published.get(schema.name)?.fields ?? []).map((field) => protobuf.util.camelCase(field.name)).sort(),
    first: type.toObject(decoded, plain),
    messages: 0,
    points: 0,
  });
  found.messages += 1;
  if (schema.name === "foxglove.PointCloud") found.points += decoded.data.length / decoded.point_stride;
}
const metadata = {};
for await (const record of mcap.readMetadata()) metadata[record.name] = Object.fromEntries(record.metadata);
await handle.close();
console.log(JSON.stringify({ topics, metadata }));
