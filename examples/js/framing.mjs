/**
 * @file The sub-protocol `sightline.v1`: `hello`, and one binary message per channel message. Pure; Node and browser.
 *
 *     uint16 BE length of the header block | header block | payload
 */

import { CHANNELS, WireError, decode, encode, parseKey } from "./codec.mjs";
import { Hello } from "./fields.mjs";
import { JsonError, parseJson } from "./json.mjs";

export const SUBPROTOCOL = "sightline.v1";
export const MAX_HELLO_BYTES = 1024;
export const MAX_BLOCK_BYTES = 576;
const MAX_UNKNOWN_SOURCES = 16; // security limit: waiting messages of one channel whose source is not a role
const ROLE_SOURCES = new Set(["vision", "operator", "teleop", "detector"]);
const RELAYED = new Set(["detections", "mission", "report", "overlay", "preview"]); // other peers choose the sources of these

const UTF8 = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });
const LATIN1 = new TextDecoder("latin1");
const NAMES_ONLY = /^\{"channel":"([^"\\]{1,64})"(?:,"source":"([^"\\]{0,64})")?\}/;
const CHANNEL_FIRST = /^\{"channel":"([^"\\]{1,64})",/;

/** An error that ends the connection with the close code `code`. The message is one line for the operator. */
export class PeerError extends Error {
  /** @param {number} code @param {string} reason */
  constructor(code, reason) {
    super(reason);
    this.code = code;
  }
}

/**
 * Write a hello.
 * @param {string} robot @param {string} session 8 hex digits @param {string[]} wants channels @param {string} [role]
 * @returns {string}
 */
export function helloText(robot, session, wants, role = "") {
  return JSON.stringify({ v: 1, robot, ...(role ? { role } : {}), session, wants });
}

/** Parse a hello. @param {string} text @throws {WireError} MALFORMED or UNSUPPORTED_VERSION */
export function parseHello(text) {
  const bytes = new TextEncoder().encode(text);
  if (bytes.length > MAX_HELLO_BYTES) throw new WireError("MALFORMED", `a hello has at most ${MAX_HELLO_BYTES} bytes`);
  return decode(Hello, bytes);
}

/**
 * Read the hello of a peer, and check its robot.
 * @param {string} text @param {string} robot id of the robot of this link
 * @returns {{robot: string, role: string, session: string, wants: string[]}}
 * @throws {PeerError} 1008 for an invalid hello or another robot
 */
export function readHello(text, robot) {
  let hello;
  try {
    hello = parseHello(text);
  } catch (error) {
    if (!(error instanceof WireError)) throw error;
    throw new PeerError(1008, `invalid hello: ${error.message}`);
  }
  if (hello.robot !== robot) throw new PeerError(1008, `this is robot ${robot}, not ${hello.robot}`);
  return hello;
}

/**
 * Pack a channel message.
 * @param {string} name channel @param {object} header @param {Uint8Array} payload
 * @returns {Uint8Array} one binary message
 */
export function pack(name, header, payload) {
  return join(encode({ channel: name, ...header }), payload);
}

/** Pack a message with its header as received, after an object of names unless it names its source. @param {Uint8Array} header */
export function packRaw(name, source, header, payload) {
  const isNamed = sourceOf(header) === source;
  const names = new TextEncoder().encode(isNamed ? `{"channel":"${name}",` : `{"channel":"${name}","source":"${source}"}`);
  const rest = isNamed ? header.subarray(1) : header;
  const block = new Uint8Array(names.length + rest.length);
  block.set(names);
  block.set(rest, names.length);
  return join(block, payload);
}

function sourceOf(header) {
  try {
    const text = UTF8.decode(header);
    return text.startsWith('{"') ? JSON.parse(text).source : null;
  } catch {
    return null;
  }
}

function join(block, payload) {
  const message = new Uint8Array(2 + block.length + payload.length);
  new DataView(message.buffer).setUint16(0, block.length);
  message.set(block, 2);
  message.set(payload, 2 + block.length);
  return message;
}

/**
 * Unpack a binary message.
 * @param {Uint8Array} message @param {string} role in the hello of the peer @param {string} robot in the hello of the peer
 * @returns {{channel: object, source: string, header: Uint8Array, payload: Uint8Array}|null} null for an invalid key: drop the message
 * @throws {PeerError} 1007 for an invalid header block
 */
export function unpack(message, role, robot) {
  const { key, header, payload } = splitMessage(message, role, robot);
  const parsed = parseKey(key);
  return parsed && { channel: parsed.channel, source: parsed.source, header, payload };
}

/** Split a binary message. The returned key contains the claims of the peer and is not checked yet. */
export function splitMessage(message, role, robot) {
  const size = message.length < 2 ? MAX_BLOCK_BYTES + 1 : message[0] * 256 + message[1];
  if (size > MAX_BLOCK_BYTES || message.length < 2 + size) {
    throw new PeerError(1007, `header block incomplete or over ${MAX_BLOCK_BYTES} bytes in a message of ${message.length}`);
  }
  const { name, source, header } = readBlock(message.subarray(2, 2 + size), role);
  const tail = CHANNELS[name]?.hasSource && source ? `/${source}` : "";
  return { key: `sightline/${robot}/${name}${tail}`, header, payload: message.subarray(2 + size) };
}

/** Separate the names from the header, which is counted and passed on without them. */
function readBlock(block, role) {
  const text = LATIN1.decode(block);
  const namesOnly = NAMES_ONLY.exec(text);
  if (namesOnly !== null) {
    return { name: namesOnly[1], source: namesOnly[2] ?? role, header: block.subarray(namesOnly[0].length) };
  }
  const channelFirst = CHANNEL_FIRST.exec(text);
  const fields = parseBlock(block) ?? {}; // invalid JSON: the decoder of the header rejects it
  const name = channelFirst === null ? fields.channel : channelFirst[1];
  if (typeof name !== "string") throw new PeerError(1007, "the header block names no channel");
  const source = fields.source ?? role;
  const header = channelFirst === null ? block : withBrace(block.subarray(channelFirst[0].length));
  return { name, source: typeof source === "string" ? source : "", header };
}

function parseBlock(block) {
  try {
    const fields = parseJson(UTF8.decode(block));
    return typeof fields === "object" ? fields : null;
  } catch (error) {
    if (!(error instanceof JsonError || error instanceof TypeError)) throw error;
    return null;
  }
}

function withBrace(rest) {
  const header = new Uint8Array(rest.length + 1);
  header[0] = 0x7b; // {
  header.set(rest, 1);
  return header;
}

/**
 * Compute the size of the largest message of the wanted channels.
 * @param {string[]} wants @returns {number} bytes
 */
export function messageBound(wants) {
  const payloads = wants.map((name) => CHANNELS[name]?.maxPayloadBytes ?? 0);
  return Math.max(MAX_HELLO_BYTES, 2 + MAX_BLOCK_BYTES + Math.max(0, ...payloads));
}

/** Messages that wait: the newest per channel, source and verb. The most urgent one leaves first. */
export class OutgoingQueue {
  constructor() {
    this.slots = new Map();
    this.dropped = 0;
  }

  /**
   * Add a message, in place of an older one of its slot.
   * @param {string} name channel, "" for a hello @param {string} source @param {string|Uint8Array} message
   * @param {string} [verb] of a request
   */
  put(name, source, message, verb = "") {
    const slot = `${name}/${source}/${verb}`;
    const isFull = !this.slots.has(slot) && this.isFull(name, source);
    this.dropped += this.slots.has(slot) || isFull ? 1 : 0;
    if (!isFull) this.slots.set(slot, { name, source, urgency: name === "" || verb === "stop" ? -1 : CHANNELS[name].urgency, message });
  }

  isFull(name, source) {
    if (!RELAYED.has(name) || ROLE_SOURCES.has(source)) return false;
    const unknown = [...this.slots.values()].filter((slot) => slot.name === name && !ROLE_SOURCES.has(slot.source));
    return unknown.length >= MAX_UNKNOWN_SOURCES;
  }

  /** Remove the most urgent message. @returns {string|Uint8Array|undefined} undefined if none waits */
  take() {
    let best;
    for (const [slot, { urgency }] of this.slots) {
      if (best === undefined || urgency < this.slots.get(best).urgency) best = slot;
    }
    const taken = this.slots.get(best)?.message;
    this.slots.delete(best);
    return taken;
  }
}
