/**
 * @file Codecs of the legacy protocol: base64 images, `linear-angular`, boxes joined by `-`. Pure; Node and browser.
 *
 * The peers of this folder use only `sightline.v1`. A peer for a legacy program needs these codecs.
 */

import { MAX_TWIST_BYTES, WireError, parseTwist } from "./codec.mjs";

const MAX_BOXES = 16;
const MAX_BOXES_BYTES = 1024;
const DECIMAL = "(?:[0-9]+(?:\\.[0-9]*)?|\\.[0-9]+)";
const NUMBER = `[+-]?${DECIMAL}(?:[eE][+-]?[0-9]{1,3})?`;
const DASHED = new RegExp(`^(${NUMBER})-(${NUMBER})$`);
const BOX = new RegExp(`^${DECIMAL}(?:,${DECIMAL}){3}$`);
const CLASSED_BOX = new RegExp(`^([A-Za-z0-9_ ]{1,32}),(${DECIMAL}),(${DECIMAL}),(${DECIMAL}),(${DECIMAL})$`);
const BASE64 = /^(?:[A-Za-z0-9+/]{4})*(?:[A-Za-z0-9+/]{2}==|[A-Za-z0-9+/]{3}=)?$/;

const malformed = (problem) => {
  throw new WireError("MALFORMED", problem);
};

/** Parse `linear-angular`. @param {string} text @returns {import("./limits.mjs").Twist} @throws {WireError} */
export function parseDashed(text) {
  const found = text.length > MAX_TWIST_BYTES ? null : DASHED.exec(text);
  if (found === null) return malformed("twist is not linear-angular, e.g. 0.2--0.35");
  return parseTwist(new TextEncoder().encode(`${found[1]}|${found[2]}`));
}

/** Decode an image. @param {string} text base64, with or without newlines @param {number} maxBytes @returns {Uint8Array} JPEG */
export function decodeImage(text, maxBytes) {
  const joined = text.replace(/[\r\n]/g, "");
  if (joined.length > 4 * Math.ceil(maxBytes / 3) || !BASE64.test(joined)) malformed(`image is not base64 of at most ${maxBytes} bytes`);
  const jpeg = Uint8Array.from(atob(joined), (character) => character.charCodeAt(0));
  return jpeg.length > maxBytes ? malformed(`image is over ${maxBytes} bytes`) : jpeg;
}

/**
 * Parse boxes.
 * @param {string} text
 * @returns {{y_min: number, x_min: number, y_max: number, x_max: number, label: string}[]} fractions of the image size
 */
export function parseBoxes(text) {
  const parts = text === "" ? [] : text.split("-");
  if (text.length > MAX_BOXES_BYTES || parts.length > MAX_BOXES) malformed(`at most ${MAX_BOXES} boxes`);
  return parts.map(parseBox);
}

function parseBox(text) {
  const { y_min, x_min, y_max, x_max, label } = BOX.test(text) ? plainBox(text) : classedBox(text);
  if (y_min > y_max || x_min > x_max || y_max > 1 || x_max > 1) malformed("box is outside the image");
  return { y_min, x_min, y_max, x_max, label };
}

function plainBox(text) {
  const [y_min, x_min, y_max, x_max] = text.split(",").map(Number);
  return { y_min, x_min, y_max, x_max, label: "box" };
}

function classedBox(text) {
  const found = CLASSED_BOX.exec(text);
  if (found === null) malformed("box is neither y_min,x_min,y_max,x_max nor class,x_min,y_min,x_max,y_max");
  const [x_min, y_min, x_max, y_max] = found.slice(2).map(Number);
  return { y_min, x_min, y_max, x_max, label: found[1] };
}
