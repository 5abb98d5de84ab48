// Reads a recording with the TypeScript MCAP library and prints all of it as JSON:
//   node read_recording.mjs FILE.mcap
// Every message is read twice, front to back and through the index, with all checksums verified.
import { open } from "node:fs/promises";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers, protobufFromBinaryDescriptor } from "@mcap/support";

const handle = await open(process.argv[2], "r");
const decompressHandlers = await loadDecompressHandlers();

async function* streamed() {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  for await (const part of handle.createReadStream({ start: 0, autoClose: false })) {
    reader.append(part);
    for (let record = reader.nextRecord(); record; record = reader.nextRecord()) yield record;
  }
  if (!reader.done()) throw new Error("the file ends too early");
}

const text = (data) => new TextDecoder().decode(data);
const schemas = new Map();
const channels = new Map();
const result = { library: "", messages: {}, attachments: {}, metadata: {}, indexed: {}, counts: {} };

function decode(message) {
  const { topic, schemaId } = channels.get(message.channelId);
  const value = schemas.get(schemaId).decode(message.data);
  const plain = value.$type.toObject(value, { longs: String, enums: String, json: true, defaults: true });
  return [topic, { log_time: message.logTime.toString(), ...plain }];
}

for await (const record of streamed()) {
  if (record.type === "Header") result.library = record.library;
  else if (record.type === "Schema") {
    schemas.set(record.id, protobufFromBinaryDescriptor(record.data).lookupType(record.name));
  } else if (record.type === "Channel") channels.set(record.id, record);
  else if (record.type === "Attachment") result.attachments[record.name] = text(record.data);
  else if (record.type === "Metadata") result.metadata[record.name] = Object.fromEntries(record.metadata);
  else if (record.type === "Message") {
    const [topic, message] = decode(record);
    (result.messages[topic] ??= []).push(message);
  } else if (record.type === "Statistics") {
    for (const [id, count] of record.channelMessageCounts) result.counts[channels.get(id).topic] = Number(count);
  }
}

const indexed = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(handle), decompressHandlers });
for await (const message of indexed.readMessages({ validateCrcs: true })) {
  const [topic, decoded] = decode(message);
  (result.indexed[topic] ??= []).push(decoded);
}
await handle.close();
process.stdout.write(JSON.stringify(result));
