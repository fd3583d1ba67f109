/**
 * @file Parse strict JSON, and distinguish integers from reals, which `JSON.parse` does not. Pure.
 *
 * The protocol rejects `7.0` as an integer, and `JSON.parse` reads it as `7`. The last of two equal keys counts. Objects
 * have no prototype, so that `__proto__` is an ordinary key.
 */

const MAX_DEPTH = 32; // security limit, permitted by clause 2.1: messages of the protocol have at most 4 levels
const NUMBER = /-?(?:0|[1-9][0-9]*)(\.[0-9]+)?([eE][+-]?[0-9]+)?/y;
const PLAIN = /[^"\\\u0000-\u001f]*/y;
const BLANKS = /[ \t\n\r]*/y;
const ESCAPES = { '"': '"', "\\": "\\", "/": "/", b: "\b", f: "\f", n: "\n", r: "\r", t: "\t" };
const WORDS = [["true", true], ["false", false], ["null", null]];

/** A number written with a point or an exponent. */
export class Real {
  /** @param {number} value */
  constructor(value) {
    this.value = value;
  }
}

/** Invalid JSON. */
export class JsonError extends Error {}

/**
 * Parse a JSON text.
 * @param {string} text
 * @returns {unknown} integers as numbers, other numbers as {@link Real}
 * @throws {JsonError}
 */
export function parseJson(text) {
  const reader = new Reader(text);
  const value = reader.value(0);
  if (reader.at !== text.length) throw new JsonError(`unexpected text at character ${reader.at}`);
  return value;
}

class Reader {
  constructor(text) {
    this.text = text;
    this.at = 0;
  }

  value(depth) {
    if (depth > MAX_DEPTH) throw new JsonError("nested too deeply");
    this.match(BLANKS);
    const value = this.bare(depth);
    this.match(BLANKS);
    return value;
  }

  bare(depth) {
    switch (this.text[this.at]) {
      case "{":
        return this.object(depth);
      case "[":
        return this.array(depth);
      case '"':
        return this.string();
      default:
        return this.scalar();
    }
  }

  object(depth) {
    const object = Object.create(null);
    this.items("}", () => {
      this.match(BLANKS);
      const name = this.string();
      this.match(BLANKS);
      this.expect(":");
      object[name] = this.value(depth + 1);
    });
    return object;
  }

  array(depth) {
    const array = [];
    this.items("]", () => array.push(this.value(depth + 1)));
    return array;
  }

  /** Read items separated by commas up to `end`. */
  items(end, readOne) {
    this.at += 1;
    this.match(BLANKS);
    if (this.text[this.at] === end) {
      this.at += 1;
      return;
    }
    for (;;) {
      readOne();
      this.match(BLANKS);
      if (this.text[this.at] === end) break;
      this.expect(",");
    }
    this.at += 1;
  }

  string() {
    this.expect('"');
    let value = "";
    for (;;) {
      value += this.match(PLAIN)[0];
      const next = this.text[this.at++];
      if (next === '"') break;
      if (next !== "\\") throw new JsonError("a string without an end, or with a control character");
      value += this.escape();
    }
    if (!value.isWellFormed()) throw new JsonError("an unpaired surrogate");
    return value;
  }

  escape() {
    const letter = this.text[this.at++];
    if (letter in ESCAPES) return ESCAPES[letter];
    const digits = this.text.slice(this.at, this.at + 4);
    if (letter !== "u" || !/^[0-9a-fA-F]{4}$/.test(digits)) throw new JsonError("an unknown escape in a string");
    this.at += 4;
    return String.fromCharCode(parseInt(digits, 16));
  }

  scalar() {
    for (const [word, value] of WORDS) {
      if (this.text.startsWith(word, this.at)) {
        this.at += word.length;
        return value;
      }
    }
    const found = this.match(NUMBER);
    if (found === null) throw new JsonError(`no value at character ${this.at}`);
    const isInteger = found[1] === undefined && found[2] === undefined;
    return isInteger ? Number(found[0]) : new Real(Number(found[0]));
  }

  match(pattern) {
    pattern.lastIndex = this.at;
    const found = pattern.exec(this.text);
    if (found !== null) this.at = pattern.lastIndex;
    return found;
  }

  expect(character) {
    if (this.text[this.at] !== character) throw new JsonError(`missing ${character} at character ${this.at}`);
    this.at += 1;
  }
}
