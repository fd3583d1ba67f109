/**
 * @file Decode a JPEG at an eighth of its size: the mean color of each 8x8 block, from the DC coefficients alone. Pure.
 *
 * This is enough to find a colored blob, without an inverse DCT. It reads baseline Huffman images, and the first DC scan
 * of progressive ones (ITU-T T.81). Check the size of the image with `readJpegSize` first.
 */

import { WireError } from "./codec.mjs";

const malformed = (problem) => {
  throw new WireError("MALFORMED", `image: ${problem}`);
};

/**
 * Decode the mean color of each block.
 * @param {Uint8Array} jpeg
 * @returns {{width: number, height: number, scale: number, rgb: Uint8ClampedArray}} size in blocks of `scale` x `scale` px
 * @throws {WireError} MALFORMED
 */
export function decodeDc(jpeg) {
  const decoder = new DcDecoder();
  let at = 2;
  while (at + 4 <= jpeg.length) {
    if (jpeg[at] !== 0xff) malformed(`no marker at byte ${at}`);
    const marker = jpeg[at + 1];
    if (marker === 0xff || marker === 0x01) {
      at += marker === 0xff ? 1 : 2;
      continue;
    }
    if (marker === 0xd9) break;
    const end = at + 2 + jpeg[at + 2] * 256 + jpeg[at + 3];
    const segment = jpeg.subarray(at + 4, end);
    at = marker === 0xda ? decoder.readScan(segment, jpeg, end) : end;
    if (marker !== 0xda) decoder.readTable(marker, segment);
    if (decoder.isComplete()) return decoder.colors();
  }
  return malformed("no complete scan");
}

class DcDecoder {
  constructor() {
    this.quantum = [];
    this.tables = {}; // "0/1": DC table 1, "1/0": AC table 0
    this.components = [];
    this.restart = 0;
    this.progressive = false;
  }

  readTable(marker, data) {
    if (marker === 0xdb) this.readQuantisation(data);
    else if (marker === 0xc4) this.readHuffman(data);
    else if (marker === 0xdd) this.restart = data[0] * 256 + data[1];
    else if (marker >= 0xc0 && marker <= 0xc2) this.readFrame(marker, data);
  }

  readQuantisation(data) {
    for (let at = 0; at < data.length; ) {
      const wide = data[at] >> 4;
      this.quantum[data[at] & 15] = wide ? data[at + 1] * 256 + data[at + 2] : data[at + 1]; // only the DC entry
      at += 1 + (wide ? 128 : 64);
    }
  }

  readHuffman(data) {
    for (let at = 0; at + 17 <= data.length; ) {
      const counts = data.subarray(at + 1, at + 17);
      const total = counts.reduce((sum, count) => sum + count, 0);
      this.tables[`${data[at] >> 4}/${data[at] & 15}`] = huffmanTable(counts, data.subarray(at + 17, at + 17 + total));
      at += 17 + total;
    }
  }

  readFrame(marker, data) {
    this.progressive = marker === 0xc2;
    this.height_px = data[1] * 256 + data[2];
    this.width_px = data[3] * 256 + data[4];
    for (let index = 0; index < data[5]; index += 1) {
      const [id, sampling, quantiser] = data.subarray(6 + index * 3, 9 + index * 3);
      const [across, down] = [sampling >> 4, sampling & 15];
      if (!(across >= 1 && across <= 4 && down >= 1 && down <= 4)) malformed("invalid sampling factors");
      this.components.push({ id, across, down, quantiser, values: null, last: 0 });
    }
    this.maxAcross = Math.max(...this.components.map((component) => component.across));
    this.maxDown = Math.max(...this.components.map((component) => component.down));
    this.mcusAcross = Math.ceil(this.width_px / (8 * this.maxAcross));
    this.mcusDown = Math.ceil(this.height_px / (8 * this.maxDown));
    for (const component of this.components) component.stride = this.mcusAcross * component.across;
  }

  /** Read a scan. @returns {number} offset of the next marker */
  readScan(head, jpeg, start) {
    const scanned = [];
    for (let index = 0; index < head[0]; index += 1) {
      const component = this.components.find(({ id }) => id === head[1 + index * 2]) ?? malformed("a scan of an unknown component");
      const chosen = head[2 + index * 2];
      scanned.push({ component, dc: this.tables[`0/${chosen >> 4}`], ac: this.tables[`1/${chosen & 15}`] });
    }
    const [from, , approximation] = head.subarray(1 + head[0] * 2);
    if (from === 0 && approximation >> 4 === 0) this.readBlocks(scanned, new Bits(jpeg, start), approximation & 15);
    return nextMarker(jpeg, start);
  }

  readBlocks(scanned, bits, shift) {
    const isSingle = scanned.length === 1;
    for (const { component, dc, ac } of scanned) {
      if (dc === undefined || (ac === undefined && !this.progressive)) malformed("a scan without its Huffman table");
      component.values = new Int16Array(component.stride * this.mcusDown * component.down);
      component.last = 0;
    }
    const { component } = scanned[0];
    const across = isSingle ? Math.ceil((this.width_px * component.across) / (8 * this.maxAcross)) : this.mcusAcross;
    const down = isSingle ? Math.ceil((this.height_px * component.down) / (8 * this.maxDown)) : this.mcusDown;
    for (let mcu = 0; mcu < across * down; mcu += 1) {
      if (this.restart && mcu > 0 && mcu % this.restart === 0) this.restartAt(bits, scanned);
      const [x, y] = [mcu % across, Math.floor(mcu / across)];
      for (const part of scanned) this.readMcu(part, bits, shift, x, y, isSingle);
    }
  }

  restartAt(bits, scanned) {
    bits.skipRestart();
    for (const { component } of scanned) component.last = 0;
  }

  readMcu({ component, dc, ac }, bits, shift, x, y, isSingle) {
    const [wide, high] = isSingle ? [1, 1] : [component.across, component.down];
    for (let block = 0; block < wide * high; block += 1) {
      component.last += bits.signed(bits.symbol(dc));
      if (!this.progressive) skipAc(bits, ac);
      component.values[(y * high + Math.floor(block / wide)) * component.stride + x * wide + (block % wide)] = component.last << shift;
    }
  }

  isComplete() {
    return this.components.length > 0 && this.components.every((component) => component.values !== null);
  }

  colors() {
    const [width, height] = [Math.ceil(this.width_px / 8), Math.ceil(this.height_px / 8)];
    const rgb = new Uint8ClampedArray(width * height * 3);
    const levels = [0, 0, 0];
    for (let y = 0, at = 0; y < height; y += 1) {
      for (let x = 0; x < width; x += 1, at += 3) {
        this.components.forEach((component, index) => {
          const block = Math.floor((y * component.down) / this.maxDown) * component.stride + Math.floor((x * component.across) / this.maxAcross);
          levels[index] = (component.values[block] * this.quantum[component.quantiser]) / 8;
        });
        const [luma, blue, red] = levels;
        rgb[at] = luma + 128 + 1.402 * red;
        rgb[at + 1] = luma + 128 - 0.344136 * blue - 0.714136 * red;
        rgb[at + 2] = luma + 128 + 1.772 * blue;
      }
    }
    return { width, height, scale: 8, rgb };
  }
}

function skipAc(bits, table) {
  for (let index = 1; index < 64; index += 1) {
    const symbol = bits.symbol(table);
    if (symbol === 0) return;
    index += symbol >> 4;
    bits.skip(symbol & 15);
  }
}

function nextMarker(jpeg, start) {
  for (let at = start; at + 1 < jpeg.length; at += 1) {
    const next = jpeg[at + 1];
    if (jpeg[at] === 0xff && next !== 0 && next !== 0xff && (next < 0xd0 || next > 0xd7)) return at;
  }
  return jpeg.length;
}

/** Build the lookup table of the next 16 bits: symbol * 32 + the length of its code, or 0 without a code. */
function huffmanTable(counts, symbols) {
  const table = new Uint16Array(65_536);
  let [code, index] = [0, 0];
  for (let length = 1; length <= 16; length += 1) {
    const span = 1 << (16 - length);
    for (let count = 0; count < counts[length - 1]; count += 1) {
      table.fill(symbols[index] * 32 + length, code, code + span);
      index += 1;
      code += span;
    }
  }
  return table;
}

/** Bits of a scan, most significant first, without the stuffed zero after 0xFF. */
class Bits {
  constructor(data, at) {
    this.data = data;
    this.at = at;
    this.buffer = this.held = this.padding = 0;
  }

  fill() {
    while (this.held < 16) {
      const byte = this.data[this.at];
      const ended = byte === undefined || (byte === 0xff && this.data[this.at + 1] !== 0);
      this.buffer = ((this.buffer << 8) | (ended ? 0 : byte)) & 0xffffff;
      this.held += 8;
      if (ended) this.padding += 8;
      else this.at += byte === 0xff ? 2 : 1;
    }
  }

  skip(count) {
    this.fill();
    this.held -= count;
    if (this.held < this.padding) malformed("scan cut short");
  }

  symbol(table) {
    this.fill();
    const found = table[(this.buffer >> (this.held - 16)) & 0xffff];
    if (found === 0) malformed("invalid Huffman code");
    this.skip(found & 31);
    return found >> 5;
  }

  /** Read a signed number of `size` bits (T.81, F.2.2.1: the upper half is positive). */
  signed(size) {
    if (size === 0) return 0;
    if (size > 15) malformed("a coefficient of over 15 bits");
    this.fill();
    const value = (this.buffer >> (this.held - size)) & ((1 << size) - 1);
    this.skip(size);
    return value < 1 << (size - 1) ? value - (1 << size) + 1 : value;
  }

  skipRestart() {
    this.buffer = this.held = this.padding = 0;
    if (this.data[this.at] !== 0xff || (this.data[this.at + 1] & 0xf8) !== 0xd0) malformed("missing restart marker");
    this.at += 2;
  }
}
