/**
 * @file Draw the camera image of a yellow ball on a gray floor as a JPEG. Pure.
 *
 * Each 8x8 block has one color, so that the JPEG contains only DC coefficients: no transform, no AC codes.
 */

const WIDTH_PX = 640;
const HEIGHT_PX = 480;
const FOCAL_PX = 400;
const CAMERA_HEIGHT_M = 0.12;
const BALL_RADIUS_M = 0.1;
const COLORS = { ball: [235, 200, 20], floor: [120, 120, 122], wall: [165, 170, 175] };
const DC_COUNTS = [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0]; // T.81, table K.3
const DC_SYMBOLS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11];
const DC_QUANTUM = 8; // makes the coefficient of a flat block equal to its level

/** CameraModel of the drawn images. */
export const DRAWN_CAMERA = Object.freeze({
  width_px: WIDTH_PX, height_px: HEIGHT_PX, fx_px: FOCAL_PX, fy_px: FOCAL_PX, cx_px: WIDTH_PX / 2, cy_px: HEIGHT_PX / 2,
  z_m: CAMERA_HEIGHT_M, calibrated: true,
});

/** Compute the position of the ball. It swings with a period of 20 s, always visible from the start pose of the robot. */
export function ballAt(t_us) {
  const angle_rad = 0.5 * Math.sin((t_us / 20e6) * 2 * Math.PI);
  return { x_m: 1.5 * Math.cos(angle_rad), y_m: 1.5 * Math.sin(angle_rad) };
}

/**
 * Draw one image.
 * @param {{x_m: number, y_m: number, yaw_rad: number}} pose of the robot
 * @param {{x_m: number, y_m: number}} ball
 * @param {number} [noise] varies the brightness of one block: no two images of a live camera are equal
 * @returns {Uint8Array} JPEG
 */
export function drawJpeg(pose, ball, noise = 0) {
  const circle = projectBall(pose, ball);
  const [across, down] = [WIDTH_PX / 8, HEIGHT_PX / 8];
  return encodeFlat(across, down, (x, y) => {
    if (x === 0 && y === 0) return COLORS.wall.map((level) => level + (noise % 8));
    const light = circle === null ? null : lightAt(circle, x * 8 + 4, y * 8 + 4);
    if (light !== null) return COLORS.ball.map((level) => Math.round(level * light));
    return y * 8 > HEIGHT_PX / 2 ? COLORS.floor : COLORS.wall;
  });
}

/** Compute the brightness of the ball at a pixel, 0..1, under a lamp above; null outside the ball. */
function lightAt(circle, x_px, y_px) {
  const [right, down] = [(x_px - circle.x_px) / circle.radius_px, (y_px - circle.y_px) / circle.radius_px];
  const square = 1 - right * right - down * down;
  return square < 0 ? null : 0.35 + 0.65 * Math.max(0, 0.52 * Math.sqrt(square) - 0.3 * right - 0.8 * down);
}

function projectBall(pose, ball) {
  const [dx_m, dy_m] = [ball.x_m - pose.x_m, ball.y_m - pose.y_m];
  const ahead_m = dx_m * Math.cos(pose.yaw_rad) + dy_m * Math.sin(pose.yaw_rad);
  const left_m = dy_m * Math.cos(pose.yaw_rad) - dx_m * Math.sin(pose.yaw_rad);
  if (ahead_m < BALL_RADIUS_M) return null;
  return {
    x_px: WIDTH_PX / 2 - (FOCAL_PX * left_m) / ahead_m,
    y_px: HEIGHT_PX / 2 + (FOCAL_PX * (CAMERA_HEIGHT_M - BALL_RADIUS_M)) / ahead_m,
    radius_px: (FOCAL_PX * BALL_RADIUS_M) / ahead_m,
  };
}

/**
 * Encode a baseline JPEG of flat blocks.
 * @param {number} across blocks @param {number} down blocks
 * @param {(x: number, y: number) => number[]} colorOf red, green, blue of a block, 0 to 255
 */
export function encodeFlat(across, down, colorOf) {
  const bits = new BitWriter();
  const last = [0, 0, 0];
  for (let block = 0; block < across * down; block += 1) {
    toYcc(colorOf(block % across, Math.floor(block / across))).forEach((level, index) => {
      bits.difference(level - last[index]);
      last[index] = level;
    });
  }
  return Uint8Array.from([0xff, 0xd8, ...headerSegments(across * 8, down * 8), ...bits.finish(), 0xff, 0xd9]);
}

function toYcc([red, green, blue]) {
  const luma = 0.299 * red + 0.587 * green + 0.114 * blue;
  return [luma - 128, (blue - luma) / 1.772, (red - luma) / 1.402].map((level) => Math.max(-128, Math.min(127, Math.round(level))));
}

const uint16 = (value) => [value >> 8, value & 0xff];
const segment = (marker, data) => [0xff, marker, ...uint16(data.length + 2), ...data];

function headerSegments(width_px, height_px) {
  const components = [1, 2, 3].flatMap((id) => [id, 0x11, 0]);
  return [
    ...segment(0xe0, [0x4a, 0x46, 0x49, 0x46, 0, 1, 1, 0, 0, 1, 0, 1, 0, 0]), // JFIF
    ...segment(0xdb, [0, ...new Array(64).fill(DC_QUANTUM)]),
    ...segment(0xc0, [8, ...uint16(height_px), ...uint16(width_px), 3, ...components]),
    ...segment(0xc4, [0x00, ...DC_COUNTS, ...DC_SYMBOLS]),
    ...segment(0xc4, [0x10, 1, ...new Array(15).fill(0), 0x00]), // one code, "0": end of block
    ...segment(0xda, [3, 1, 0, 2, 0, 3, 0, 0, 63, 0]),
  ];
}

/** Huffman code of each size of a DC difference: [code, length]. */
const DC_CODES = (() => {
  const codes = [];
  let code = 0;
  DC_COUNTS.forEach((count, index) => {
    for (let number = 0; number < count; number += 1) codes.push([code++, index + 1]);
    code <<= 1;
  });
  return codes;
})();

class BitWriter {
  constructor() {
    this.bytes = [];
    this.buffer = this.held = 0;
  }

  difference(value) {
    const size = value === 0 ? 0 : 32 - Math.clz32(Math.abs(value));
    this.write(...DC_CODES[size]);
    this.write(value < 0 ? value + (1 << size) - 1 : value, size);
    this.write(0, 1); // end of block
  }

  write(value, length) {
    this.buffer = (this.buffer << length) | value;
    this.held += length;
    while (this.held >= 8) {
      const byte = (this.buffer >> (this.held - 8)) & 0xff;
      this.bytes.push(byte, ...(byte === 0xff ? [0] : []));
      this.held -= 8;
    }
    this.buffer &= (1 << this.held) - 1;
  }

  finish() {
    this.write((1 << (8 - this.held)) - 1, 8 - this.held);
    return this.bytes;
  }
}
