/**
 * @file Limits of a robot, and the ramp that applies them. Pure.
 *
 * @typedef {{linear_mps: number, angular_rad_s: number}} Twist
 */

/** @type {Twist} */
export const STILL = Object.freeze({ linear_mps: 0, angular_rad_s: 0 });
export const TICK_US = 20_000; // 50 Hz

/**
 * Default times and limits of the protocol. A robot at 0.5 m/s stops 300 + 250 ms after its last command (silence, then
 * 2 m/s2), within the promised 700 ms.
 */
export const LIMITS = Object.freeze({
  maxLinear_mps: 0.5,
  maxAngular_rad_s: 2.5,
  maxAcceleration_mps2: 2,
  maxAcceleration_rad_s2: 12,
  fullSpeedAge_us: 150_000,
  zeroSpeedAge_us: 400_000,
  silence_us: 300_000,
  lease_us: 1_000_000,
  disarmAfterHold_us: 10_000_000,
  liveCommandsToArm: 5,
  guests: false,
  guestLife_us: 250_000,
  guestMaxLinear_mps: 0.2,
  guestMaxAngular_rad_s: 1,
  guestUnchanged_us: 2_000_000,
  guestUnchanged_m: 0.25,
  autoArm: false,
  needsProof: false, // true where peers show keys (6.6)
});

/** Compute the share of the speed limit for a frame of this age: 1 up to `fullSpeedAge_us`, then linearly down to 0. */
export function ageFactor(limits, age_us) {
  const span_us = limits.zeroSpeedAge_us - limits.fullSpeedAge_us;
  return Math.min(1, Math.max(0, (limits.zeroSpeedAge_us - age_us) / span_us));
}

/**
 * Scale both axes by one factor until both limits hold, so that the curve does not change.
 * @param {Twist} twist @returns {Twist} the same object if it is within the limits
 */
export function clampTwist(twist, maxLinear_mps, maxAngular_rad_s) {
  if (maxLinear_mps <= 0 || maxAngular_rad_s <= 0) return STILL;
  const excess = Math.max(Math.abs(twist.linear_mps) / maxLinear_mps, Math.abs(twist.angular_rad_s) / maxAngular_rad_s);
  if (excess <= 1) return twist;
  return { linear_mps: twist.linear_mps / excess, angular_rad_s: twist.angular_rad_s / excess };
}

/** Limits the acceleration of the wheels, per elapsed time and not per call. */
export class Ramp {
  constructor(limits) {
    this.limits = limits;
    this.twist = STILL;
  }

  /** Approach the goal. @param {Twist} goal @param {number} elapsed_us @returns {Twist} */
  step(goal, elapsed_us) {
    const elapsed_s = Math.min(elapsed_us, 1_000_000) / 1e6;
    const linear = approach(this.twist.linear_mps, goal.linear_mps, this.limits.maxAcceleration_mps2 * elapsed_s);
    const angular = approach(this.twist.angular_rad_s, goal.angular_rad_s, this.limits.maxAcceleration_rad_s2 * elapsed_s);
    this.twist = { linear_mps: linear, angular_rad_s: angular };
    return this.twist;
  }
}

const approach = (from, to, most) => from + Math.max(-most, Math.min(most, to - from));

export const isStill = (twist) => twist.linear_mps === 0 && twist.angular_rad_s === 0;
