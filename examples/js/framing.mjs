/**
 * @file The sub-protocol `sightline.v1`: `hello`, and channel messages as one binary message each. Pure; Node and browser.
 *
 *     uint16 BE length of the header block | header block | payload
 */

import { CHANNELS, WireError, decode, encode, parseKey } from "./codec.mjs";
import { Hello } from "./fields.mjs";
import { JsonError, parseJson } from "./json.mjs";

export const SUBPROTOCOL = "sightline.v1";
export const MAX_HELLO_BYTES = 1024;
export const MAX_BLOCK_BYTES = 576;
const MAX_UNKNOWN_SOURCES = 16; // security limit: of one channel, messages that wait and whose source is no role's
const ROLE_SOURCES = new Set(["vision", "operator", "teleop", "detector"]);
const RELAYED = new Set(["detections", "mission", "report", "overlay", "preview"]); // their sources others choose

const UTF8 = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true });
const LATIN1 = new TextDecoder("latin1");
const NAMES_ONLY = /^\{"channel":"([^"\\]{1,64})"(?:,"source":"([^"\\]{0,64})")?\}/;
const CHANNEL_FIRST = /^\{"channel":"([^"\\]{1,64})",/;

/** The connection must end with this close code; the message is the reason, one line for a person. */
export class PeerError extends Error {
  /** @param {number} code @param {string} reason */
  constructor(code, reason) {
    super(reason);
    this.code = code;
  }
}

/**
 * @param {string} robot @param {string} session 8 hex digits @param {string[]} wants channels @param {string} [role]
 * @returns {string}
 */
export function helloText(robot, session, wants, role = "") {
  return JSON.stringify({ v: 1, robot, ...(role ? { role } : {}), session, wants });
}

/** @param {string} text @throws {WireError} MALFORMED or UNSUPPORTED_VERSION */
export function parseHello(text) {
  const bytes = new TextEncoder().encode(text);
  if (bytes.length > MAX_HELLO_BYTES) throw new WireError("MALFORMED", `a hello has at most ${MAX_HELLO_BYTES} bytes`);
  return decode(Hello, bytes);
}

/**
 * Read a peer's hello, and agree on the robot.
 * @param {string} text @param {string} robot whose link this is
 * @returns {{robot: string, role: string, session: string, wants: string[]}}
 * @throws {PeerError} 1008
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
 * @param {string} name channel @param {object} header @param {Uint8Array} payload
 * @returns {Uint8Array} one binary message
 */
export function pack(name, header, payload) {
  return join(encode({ channel: name, ...header }), payload);
}

/** The same for a header as it came: unless it names its source, it follows an object of names. @param {Uint8Array} header */
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
 * Take a binary message apart.
 * @param {Uint8Array} message @param {string} role of the peer's hello @param {string} robot of the peer's hello
 * @returns {{channel: object, source: string, header: Uint8Array, payload: Uint8Array}|null} null: dropped, no such key
 * @throws {PeerError} 1007 for what cannot be taken apart
 */
export function unpack(message, role, robot) {
  const { key, header, payload } = splitMessage(message, role, robot);
  const parsed = parseKey(key);
  return parsed && { channel: parsed.channel, source: parsed.source, header, payload };
}

/** The same with the key as the peer claims it, still to be checked. */
export function splitMessage(message, role, robot) {
  const size = message.length < 2 ? MAX_BLOCK_BYTES + 1 : message[0] * 256 + message[1];
  if (size > MAX_BLOCK_BYTES || message.length < 2 + size) {
    throw new PeerError(1007, `header block cut or over ${MAX_BLOCK_BYTES} bytes in a message of ${message.length}`);
  }
  const { name, source, header } = readBlock(message.subarray(2, 2 + size), role);
  const tail = CHANNELS[name]?.hasSource && source ? `/${source}` : "";
  return { key: `sightline/${robot}/${name}${tail}`, header, payload: message.subarray(2 + size) };
}

/** The names in front of the header are no part of it, and do not count among its bytes. */
function readBlock(block, role) {
  const text = LATIN1.decode(block);
  const namesOnly = NAMES_ONLY.exec(text);
  if (namesOnly !== null) {
    return { name: namesOnly[1], source: namesOnly[2] ?? role, header: block.subarray(namesOnly[0].length) };
  }
  const channelFirst = CHANNEL_FIRST.exec(text);
  const fields = parseBlock(block) ?? {}; // broken JSON: whoever reads the header refuses it
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
 * The largest message that an end which wants these channels accepts.
 * @param {string[]} wants
 */
export function messageBound(wants) {
  const payloads = wants.map((name) => CHANNELS[name]?.maxPayloadBytes ?? 0);
  return Math.max(MAX_HELLO_BYTES, 2 + MAX_BLOCK_BYTES + Math.max(0, ...payloads));
}

/** Slots of messages that have not left: one per channel, source and verb, the newest; the most urgent leaves first. */
export class OutgoingQueue {
  constructor() {
    this.slots = new Map();
    this.dropped = 0;
  }

  /**
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

  /** @returns {string|Uint8Array|undefined} */
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
