/**
 * @file Prove that commands are of one sender (6.6): each reveals one more element of a hash chain. Pure.
 *
 * It contains SHA-256 (FIPS 180-4), because that of a browser is asynchronous.
 */

const ELEMENT_BYTES = 16;
const MAX_LOST = 64;
const LENGTH = 1024;
const ANNOUNCED = 2 * MAX_LOST;

const PRIMES = [];
for (let number = 2; PRIMES.length < 64; number += 1) if (PRIMES.every((prime) => number % prime !== 0)) PRIMES.push(number);
const fraction = (value) => Math.floor((value - Math.floor(value)) * 2 ** 32) | 0;
const START = PRIMES.slice(0, 8).map((prime) => fraction(Math.sqrt(prime)));
const ROUNDS = PRIMES.map((prime) => fraction(Math.cbrt(prime)));
const rotate = (word, by) => (word >>> by) | (word << (32 - by));

/** Compute SHA-256. @param {Uint8Array} data at most 55 bytes, one block @returns {Uint8Array} */
export function sha256(data) {
  const block = new DataView(new ArrayBuffer(64));
  data.forEach((byte, at) => block.setUint8(at, byte));
  block.setUint8(data.length, 0x80);
  block.setUint32(60, data.length * 8);
  const words = new Int32Array(64);
  for (let at = 0; at < 64; at += 1) {
    if (at < 16) {
      words[at] = block.getInt32(4 * at);
      continue;
    }
    const [far, near] = [words[at - 15], words[at - 2]];
    const mixed = rotate(far, 7) ^ rotate(far, 18) ^ (far >>> 3);
    words[at] = words[at - 16] + mixed + words[at - 7] + (rotate(near, 17) ^ rotate(near, 19) ^ (near >>> 10));
  }
  let [a, b, c, d, e, f, g, h] = START;
  for (let at = 0; at < 64; at += 1) {
    const one = (h + (rotate(e, 6) ^ rotate(e, 11) ^ rotate(e, 25)) + ((e & f) ^ (~e & g)) + ROUNDS[at] + words[at]) | 0;
    const two = ((rotate(a, 2) ^ rotate(a, 13) ^ rotate(a, 22)) + ((a & b) ^ (a & c) ^ (b & c))) | 0;
    [h, g, f, e, d, c, b, a] = [g, f, e, (d + one) | 0, c, b, a, (one + two) | 0];
  }
  const result = new DataView(new ArrayBuffer(32));
  [a, b, c, d, e, f, g, h].forEach((word, at) => result.setInt32(4 * at, (word + START[at]) | 0));
  return new Uint8Array(result.buffer);
}

const hex = (bytes) => [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
const fromHex = (text) => Uint8Array.from(text.match(/../g), (pair) => parseInt(pair, 16));
const hashed = (element) => sha256(element).subarray(0, ELEMENT_BYTES);

/** The chain of one sender. It continues in another chain before it ends. */
export class ProofChain {
  /** @param {(bytes: Uint8Array) => Uint8Array} draw fills with random bytes */
  constructor(draw = (bytes) => globalThis.crypto.getRandomValues(bytes)) {
    this.draw = draw;
    this.elements = this.newElements();
    this.following = [];
    this.announced = undefined;
  }

  newElements() {
    const elements = [this.draw(new Uint8Array(ELEMENT_BYTES))];
    while (elements.length < LENGTH) elements.push(hashed(elements.at(-1)));
    return elements;
  }

  /** Return the proof fields of the header of the next command. @returns {{proof: string, next_proof?: string}} */
  next() {
    if (this.elements.length === 0) [this.elements, this.following, this.announced] = [this.following, [], undefined];
    const proof = hex(this.elements.pop());
    if (this.announced === undefined && this.elements.length < ANNOUNCED) {
      this.following = this.newElements();
      this.announced = hex(this.following.pop()); // the announced element is public, so it proves nothing
    }
    return this.announced === undefined ? { proof } : { proof, next_proof: this.announced };
  }
}

/** Return true if the sender of `last` revealed `proof`, at most MAX_LOST commands later. */
export function continues(proof, last) {
  if (proof === null) return false;
  let element = fromHex(proof);
  for (let count = 0; count < MAX_LOST; count += 1) {
    element = hashed(element);
    const text = hex(element);
    if (text === last.proof || text === last.next_proof) return true;
  }
  return false;
}

/** Compute the digest by which a robot shows the session of a driver: 8 hex digits. */
export const sessionDigest = (source, session) => hex(sha256(new TextEncoder().encode(`${source}/${session}`))).slice(0, 8);
