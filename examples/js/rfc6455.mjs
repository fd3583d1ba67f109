/**
 * @file Encode and decode WebSocket frames (RFC 6455). Pure; for Node only.
 *
 * Each end passes the bytes of its socket to a {@link FrameReader}, which returns whole messages and control frames.
 */

import { PeerError } from "./framing.mjs";

export const OPCODE = { CONTINUATION: 0, TEXT: 1, BINARY: 2, CLOSE: 8, PING: 9, PONG: 10 };
const MAX_CONTROL_BYTES = 125;
const EMPTY = new Uint8Array(0);

/**
 * Encode one frame.
 * @param {number} opcode
 * @param {Uint8Array} payload
 * @param {Uint8Array|null} mask four bytes of a client, null of a server
 * @returns {Uint8Array}
 */
export function encodeFrame(opcode, payload, mask = null) {
  const size = payload.length;
  const extended = size < 126 ? 0 : size < 65_536 ? 2 : 8;
  const frame = new Uint8Array(2 + extended + (mask ? 4 : 0) + size);
  const view = new DataView(frame.buffer);
  frame[0] = 0x80 | opcode;
  frame[1] = (mask ? 0x80 : 0) | (extended === 0 ? size : extended === 2 ? 126 : 127);
  if (extended === 2) view.setUint16(2, size);
  if (extended === 8) view.setBigUint64(2, BigInt(size));
  if (mask) frame.set(mask, 2 + extended);
  frame.set(payload, frame.length - size);
  if (mask) unmask(frame.subarray(frame.length - size), mask);
  return frame;
}

/** Encode a close payload. @param {number} code @param {string} reason cut after 123 bytes */
export function closePayload(code, reason) {
  let text = new TextEncoder().encode(reason);
  if (text.length > MAX_CONTROL_BYTES - 2) {
    const whole = new TextDecoder().decode(text.subarray(0, MAX_CONTROL_BYTES - 2)).replace(/\ufffd+$/, "");
    text = new TextEncoder().encode(whole);
  }
  return Uint8Array.from([code >> 8, code & 0xff, ...text]);
}

function unmask(data, mask) {
  for (let index = 0; index < data.length; index += 1) data[index] ^= mask[index & 3];
}

/** Return true for a code that a close frame may contain (RFC 6455, 7.4; IANA registry). */
const isCloseCode = (code) => (code >= 1000 && code <= 1014 && ![1004, 1005, 1006].includes(code)) || (code >= 3000 && code < 5000);

const utf8 = (bytes) => {
  try {
    return new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes);
  } catch {
    throw new PeerError(1007, "text that is not UTF-8");
  }
};

/** Assembles messages from frames and fragments. Security limit: `maxBytes` of a message, checked before it is stored. */
export class FrameReader {
  /** @param {{masked: boolean, maxBytes: number}} options `masked`: true if the other end must mask */
  constructor({ masked, maxBytes }) {
    this.masked = masked;
    this.maxBytes = maxBytes;
    this.chunks = [];
    this.stored = 0;
    this.fragments = [];
    this.fragmentBytes = 0;
    this.opcode = 0; // of the message whose fragments arrive
  }

  /**
   * Read the bytes of a chunk.
   * @param {Uint8Array} chunk
   * @returns {Generator<{kind: "text"|"binary"|"ping"|"pong"|"close", data: Uint8Array|string, code?: number}>}
   * @throws {PeerError} with the close code for the broken rule
   */
  *feed(chunk) {
    this.chunks.push(chunk);
    this.stored += chunk.length;
    for (let head = this.readHead(); head !== null && this.stored >= head.size + head.at; head = this.readHead()) {
      this.take(head.at);
      const data = this.take(head.size);
      if (head.mask) unmask(data, head.mask);
      const event = this.onFrame(head.fin, head.opcode, data);
      if (event !== null) yield event;
    }
  }

  /** Read the head of the next frame, or return null while it is incomplete. */
  readHead() {
    const bytes = this.peek(14);
    if (bytes.length < 2) return null;
    const [fin, opcode, short] = [bytes[0] >= 0x80, bytes[0] & 0x0f, bytes[1] & 0x7f];
    this.check(bytes, fin, opcode, short);
    const extended = short < 126 ? 0 : short === 126 ? 2 : 8;
    const at = 2 + extended + (this.masked ? 4 : 0);
    if (bytes.length < at) return null;
    const view = new DataView(bytes.buffer, bytes.byteOffset);
    const size = extended === 0 ? short : extended === 2 ? view.getUint16(2) : Number(view.getBigUint64(2));
    if (opcode < 8 && this.fragmentBytes + size > this.maxBytes) {
      throw new PeerError(1009, `message over ${this.maxBytes} bytes, the largest that this end accepts`);
    }
    return { fin, opcode, size, at, mask: this.masked ? bytes.slice(at - 4, at) : null };
  }

  check(bytes, fin, opcode, short) {
    const broken = (problem) => {
      throw new PeerError(1002, problem);
    };
    if (bytes[0] & 0x70) broken("a reserved bit is set without an extension");
    if ((bytes[1] >= 0x80) !== this.masked) broken(this.masked ? "a client must mask" : "a server must not mask");
    if (![0, 1, 2, 8, 9, 10].includes(opcode)) broken(`unknown opcode ${opcode}`);
    if (opcode >= 8 && (!fin || short > MAX_CONTROL_BYTES)) broken("a control frame in fragments or over 125 bytes");
    if (opcode === OPCODE.CONTINUATION && this.opcode === 0) broken("a continuation without a message");
    if ((opcode === OPCODE.TEXT || opcode === OPCODE.BINARY) && this.opcode !== 0) broken("a message within a message");
  }

  onFrame(fin, opcode, data) {
    if (opcode === OPCODE.CLOSE) return this.onClose(data);
    if (opcode >= 8) return { kind: opcode === OPCODE.PING ? "ping" : "pong", data };
    this.opcode ||= opcode;
    this.fragments.push(data);
    this.fragmentBytes += data.length;
    if (!fin) return this.bundle();
    const whole = this.fragments.length === 1 ? data : join(this.fragments, this.fragmentBytes);
    const kind = this.opcode === OPCODE.TEXT ? "text" : "binary";
    this.fragments = [];
    this.fragmentBytes = this.opcode = 0;
    return { kind, data: kind === "text" ? utf8(whole) : whole };
  }

  /** Join the fragments, because a peer can send any number of empty ones. */
  bundle() {
    if (this.fragments.length > 64) this.fragments = [join(this.fragments, this.fragmentBytes)];
    return null;
  }

  onClose(data) {
    if (data.length === 0) return { kind: "close", code: 1005, data: "" };
    const code = data.length === 1 ? 0 : data[0] * 256 + data[1];
    if (!isCloseCode(code)) throw new PeerError(1002, `invalid close code ${code}`);
    return { kind: "close", code, data: utf8(data.subarray(2)) };
  }

  /** Return up to `size` bytes from the front without removing them. */
  peek(size) {
    if ((this.chunks[0]?.length ?? 0) < size && this.chunks.length > 1) {
      this.chunks = [join(this.chunks, this.stored)];
    }
    return this.chunks[0]?.subarray(0, size) ?? EMPTY;
  }

  take(size) {
    if ((this.chunks[0]?.length ?? 0) < size) this.chunks = [join(this.chunks, this.stored)];
    const first = this.chunks[0] ?? EMPTY;
    this.stored -= size;
    if (first.length === size) this.chunks.shift();
    else this.chunks[0] = first.subarray(size);
    return first.slice(0, size);
  }
}

function join(chunks, size) {
  const whole = new Uint8Array(size);
  let at = 0;
  for (const chunk of chunks) {
    whole.set(chunk, at);
    at += chunk.length;
  }
  return whole;
}
