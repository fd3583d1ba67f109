/**
 * @file Run the codec for the conformance kit: one JSON line per question, one per answer. Shell.
 *
 *     sightline conform codec -- node examples/js/codec_adapter.mjs
 */

import { createInterface } from "node:readline";
import { fileURLToPath } from "node:url";
import { WireError, formatTwist, parseKey, readMessage } from "./codec.mjs";
import { PeerError, parseHello, splitMessage } from "./framing.mjs";
import { decodeImage, parseBoxes, parseDashed } from "./legacy_text.mjs";

const fromBase64 = (text) => new Uint8Array(Buffer.from(text, "base64"));
const fromHex = (text) => new Uint8Array(Buffer.from(text, "hex"));
const toHex = (bytes) => Buffer.from(bytes).toString("hex");

/** Make a payload valid JSON, which has no infinity: a range without return becomes "inf". */
const jsonPayload = (payload) => (Array.isArray(payload) ? payload.map((range) => (range === Infinity ? "inf" : range)) : payload);

/** Decoders by `kind` of question: `message`, `hello` ... as in the golden vectors. */
const READERS = {
  message({ key, header, payload }) {
    const parsed = parseKey(key);
    if (parsed === null) throw new WireError("INEXACT_KEY", key);
    const read = readMessage(parsed.channel, parsed.source, fromBase64(header), fromBase64(payload));
    return { ...read, payload: jsonPayload(read.payload) };
  },
  hello: ({ text }) => parseHello(text),
  websocket({ message_hex, role, robot }) {
    const { key, header, payload } = splitMessage(fromHex(message_hex), role, robot);
    return { key, header_hex: toHex(header), payload_hex: toHex(payload) };
  },
  older_dashed: ({ text }) => parseDashed(text),
  older_picture: ({ text, max_bytes }) => ({ jpeg_hex: toHex(decodeImage(text, max_bytes)) }),
  older_boxes: ({ text }) => ({ boxes: parseBoxes(text) }),
  write_twist: (twist) => new TextDecoder().decode(formatTwist(twist)),
};

/** Answer one question. @returns {object} with the key `ok`, `refusal` or `unsupported` */
export function answerTo(question) {
  if (!Object.hasOwn(READERS, question.kind)) return { unsupported: true };
  try {
    return { ok: READERS[question.kind](question) };
  } catch (error) {
    if (error instanceof PeerError) return { refusal: "MALFORMED" }; // as in the vectors
    if (!(error instanceof WireError)) throw error;
    return { refusal: error.reason };
  }
}

if (process.argv[1] === fileURLToPath(import.meta.url)) {
  for await (const line of createInterface({ input: process.stdin, crlfDelay: Infinity })) {
    const question = JSON.parse(line);
    process.stdout.write(`${JSON.stringify({ id: question.id, ...answerTo(question) })}\n`);
  }
}
