/**
 * @file Encode and decode the messages of the Sightline protocol: keys, headers, payloads, sizes. Pure; Node and browser.
 *
 * Written from `protocol/README.md` alone. Every decoder accepts any bytes and throws {@link WireError}.
 */

import * as tables from "./fields.mjs";
import { JsonError, parseJson } from "./json.mjs";

export const MAX_HEADER_BYTES = 512;
export const MAX_TWIST_BYTES = 64;
export const MAX_PIXELS = 1920 * 1080;
const MAX_SEGMENTS = 64;
const MAX_DETAIL_CHARS = 200;

/** A rejected message: `reason` is a rejection of the protocol, `message` one line for the operator. */
export class WireError extends Error {
  /** @param {string} reason @param {string} detail */
  constructor(reason, detail) {
    super(detail.slice(0, MAX_DETAIL_CHARS));
    this.reason = reason;
  }
}

/**
 * @typedef {object} Channel
 * @property {string} name
 * @property {boolean} hasSource true toward the robot: the key ends in the role of the sender
 * @property {object} header its field table
 * @property {object|null} payload its field table, or null if the payload is not JSON
 * @property {number} maxPayloadBytes
 * @property {number} urgency 0 leaves first
 */
const define = (name, hasSource, header, payload, maxPayloadBytes, urgency) => ({
  name, hasSource, header, payload, maxPayloadBytes, urgency,
});

/** @type {Record<string, Channel>} */
export const CHANNELS = Object.assign(Object.create(null), {
  frame: define("frame", false, tables.FrameHeader, null, 1_000_000, 2),
  twist: define("twist", true, tables.AnswerHeader, null, MAX_TWIST_BYTES, 0),
  ack: define("ack", true, tables.AnswerHeader, null, 0, 0),
  request: define("request", true, tables.RequestHeader, tables.Request, 256, 0),
  reply: define("reply", false, tables.Stamp, tables.Reply, 1024, 1),
  status: define("status", false, tables.Stamp, tables.Status, 4096, 1),
  odometry: define("odometry", false, tables.Stamp, tables.Odometry, 256, 2),
  scan: define("scan", false, tables.ScanHeader, null, 16_384, 3),
  camera: define("camera", false, tables.Stamp, tables.CameraModel, 1024, 1),
  detections: define("detections", true, tables.DetectionsHeader, tables.Detections, 32_768, 1),
  mission: define("mission", true, tables.RequestHeader, tables.MissionRequest, 4096, 1),
  report: define("report", true, tables.DetectionsHeader, tables.MissionReport, 2048, 1),
  overlay: define("overlay", true, tables.DetectionsHeader, null, 250_000, 3),
  preview: define("preview", true, tables.DetectionsHeader, null, 100_000, 3),
});

const IMAGE_CHANNELS = new Set(["frame", "overlay", "preview"]);
const ROBOT_ID = /^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$/;
const SOURCE = /^[a-z][a-z0-9_]{0,15}$/;
const UTF8 = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }); // keeps a byte order mark, which is invalid JSON
const ASCII_NUMBER = "[+-]?(?:[0-9]+(?:\\.[0-9]*)?|\\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?";
const TWIST = new RegExp(`^(${ASCII_NUMBER})\\|(${ASCII_NUMBER})$`);
const NOT_FINITE = /^[+-]?(?:nan|inf|infinity)$/i;

/**
 * Parse a key.
 * @param {string} key
 * @returns {{robot: string, channel: Channel, source: string}|null} null unless the key is exact
 */
export function parseKey(key) {
  const [prefix, robot, name, ...rest] = key.split("/");
  const found = name === undefined ? undefined : CHANNELS[name];
  if (prefix !== "sightline" || found === undefined || !ROBOT_ID.test(robot)) return null;
  if (rest.length !== (found.hasSource ? 1 : 0)) return null;
  const source = rest[0] ?? "";
  return found.hasSource && !SOURCE.test(source) ? null : { robot, channel: found, source };
}

/**
 * Check the sizes of a message.
 * @param {Channel} channel @param {Uint8Array} header @param {Uint8Array} payload @throws {WireError} MALFORMED
 */
export function checkSizes(channel, header, payload) {
  if (header.length > MAX_HEADER_BYTES) {
    throw new WireError("MALFORMED", `${channel.name} header is ${header.length} bytes, at most ${MAX_HEADER_BYTES}`);
  }
  if (payload.length > channel.maxPayloadBytes) {
    throw new WireError("MALFORMED", `${channel.name} payload is ${payload.length} bytes, at most ${channel.maxPayloadBytes}`);
  }
}

/**
 * Decode a JSON object by its field table.
 * @param {object} fields a table of `fields.mjs`
 * @param {Uint8Array} bytes
 * @throws {WireError} UNSUPPORTED_VERSION, or MALFORMED with the name of the first invalid field
 */
export function decode(fields, bytes) {
  try {
    return tables.readFields(fields, parseJson(UTF8.decode(bytes)));
  } catch (error) {
    if (error instanceof tables.FieldError && error.path === "v") {
      throw new WireError("UNSUPPORTED_VERSION", `another version; this peer uses ${tables.VERSION}`);
    }
    const known = error instanceof tables.FieldError || error instanceof JsonError || error instanceof TypeError;
    if (!known) throw error;
    throw new WireError("MALFORMED", error instanceof TypeError ? "not UTF-8" : error.message);
  }
}

/** Encode as JSON without blanks. Omits nulls, because `null` and absent mean the same. */
export function encode(value) {
  return new TextEncoder().encode(JSON.stringify(value, (_name, item) => item ?? undefined));
}

/**
 * Parse a twist text.
 * @param {Uint8Array} bytes
 * @returns {{linear_mps: number, angular_rad_s: number}} m/s, rad/s
 * @throws {WireError} MALFORMED or NOT_FINITE
 */
export function parseTwist(bytes) {
  if (bytes.length > MAX_TWIST_BYTES) throw new WireError("MALFORMED", `twist text is over ${MAX_TWIST_BYTES} bytes`);
  const text = String.fromCharCode(...bytes);
  const found = TWIST.exec(text);
  if (found === null) {
    const fields = text.split("|");
    const isNotFinite = fields.length === 2 && fields.some((field) => NOT_FINITE.test(field));
    throw new WireError(isNotFinite ? "NOT_FINITE" : "MALFORMED", "twist is not linear|angular, e.g. 0.2000|-0.3500");
  }
  const [linear, angular] = [Number(found[1]), Number(found[2])];
  if (!Number.isFinite(linear) || !Number.isFinite(angular)) throw new WireError("NOT_FINITE", "twist overflows");
  return { linear_mps: linear, angular_rad_s: angular };
}

/** Format a twist with four decimals, never `-0.0000`. */
export function formatTwist({ linear_mps, angular_rad_s }) {
  const decimals = (value) => value.toFixed(4).replace(/^-(0\.0000)$/, "$1");
  return new TextEncoder().encode(`${decimals(linear_mps)}|${decimals(angular_rad_s)}`);
}

/**
 * Read the image size without decoding, from at most 64 segments.
 * @param {Uint8Array} jpeg @param {number} [maxPixels] security limit, width x height
 * @returns {{width_px: number, height_px: number, components: number}}
 * @throws {WireError} MALFORMED unless it is a baseline or progressive JPEG within the limit
 */
export function readJpegSize(jpeg, maxPixels = MAX_PIXELS) {
  if (jpeg[0] !== 0xff || jpeg[1] !== 0xd8) throw new WireError("MALFORMED", "image: not a JPEG");
  let at = 2;
  for (let segment = 0; segment < MAX_SEGMENTS; segment += 1) {
    if (at + 4 > jpeg.length || jpeg[at] !== 0xff) throw new WireError("MALFORMED", `image: broken segment at byte ${at}`);
    const marker = jpeg[at + 1];
    if (marker >= 0xc0 && marker <= 0xc2) return sizeFromFrameHeader(jpeg, at, maxPixels);
    if (isUnsupported(marker)) throw new WireError("MALFORMED", `image: unsupported marker 0x${marker.toString(16)}`);
    at = nextSegment(jpeg, at, marker);
  }
  throw new WireError("MALFORMED", `image: more than ${MAX_SEGMENTS} segments before the frame header`);
}

/** Return true for a lossless, hierarchical or arithmetic frame header, and for a scan before any frame header. */
function isUnsupported(marker) {
  return (marker >= 0xc3 && marker <= 0xcf && marker !== 0xc4 && marker !== 0xc8 && marker !== 0xcc) || marker === 0xda;
}

function nextSegment(jpeg, at, marker) {
  if (marker === 0xff) return at + 1; // a fill byte
  if (marker === 0x01 || (marker >= 0xd0 && marker <= 0xd8)) return at + 2; // markers without a segment
  const length = jpeg[at + 2] * 256 + jpeg[at + 3];
  if (length < 2) throw new WireError("MALFORMED", `image: segment of length ${length} at byte ${at}`);
  return at + 2 + length;
}

function sizeFromFrameHeader(jpeg, at, maxPixels) {
  if (at + 10 > jpeg.length) throw new WireError("MALFORMED", "image: frame header cut short");
  const height = jpeg[at + 5] * 256 + jpeg[at + 6];
  const width = jpeg[at + 7] * 256 + jpeg[at + 8];
  const components = jpeg[at + 9];
  if (jpeg[at + 4] !== 8 || (components !== 1 && components !== 3)) {
    throw new WireError("MALFORMED", "image: 8 bits and 1 or 3 components are supported");
  }
  if (width * height === 0 || width * height > maxPixels) {
    throw new WireError("MALFORMED", `image: ${width}x${height} pixels, at most ${maxPixels} in total`);
  }
  return { width_px: width, height_px: height, components };
}

/**
 * Decode a scan.
 * @param {Uint8Array} bytes little-endian float32 @returns {number[]} m @throws {WireError} MALFORMED or NOT_FINITE
 */
export function decodeRanges(bytes) {
  if (bytes.length % 4 !== 0) throw new WireError("MALFORMED", "the size of the scan is not a multiple of 4 bytes");
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  const ranges = Array.from({ length: bytes.length / 4 }, (_, index) => view.getFloat32(index * 4, true));
  if (!ranges.every((range) => range >= 0)) throw new WireError("NOT_FINITE", "scan contains a nan or negative range");
  return ranges;
}

/**
 * Decode a message.
 * @param {Channel} channel @param {string} source as in the key @param {Uint8Array} header @param {Uint8Array} payload
 * @returns {{source: string, header: object|null, payload: unknown}} `header` is null for a guest without a header
 * @throws {WireError}
 */
export function readMessage(channel, source, header, payload) {
  checkSizes(channel, header, payload);
  const isBare = channel.name === "twist" && source === "guest" && header.length === 0;
  return { source, header: isBare ? null : decode(channel.header, header), payload: readPayload(channel, payload) };
}

function readPayload(channel, payload) {
  if (channel.payload !== null) return decode(channel.payload, payload);
  if (IMAGE_CHANNELS.has(channel.name)) return readJpegSize(payload);
  if (channel.name === "twist") return parseTwist(payload);
  return channel.name === "scan" ? decodeRanges(payload) : null;
}
