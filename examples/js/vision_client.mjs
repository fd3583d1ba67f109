/**
 * @file A vision service for Node: finds a yellow target in the frames of a robot and steers at it. Shell.
 *
 *     node examples/js/vision_client.mjs --connect ws://127.0.0.1:9090 --robot r1
 */

import { randomBytes } from "node:crypto";
import { readFileSync } from "node:fs";
import { parseArgs } from "node:util";
import { FrameLoop, WANTED_CHANNELS } from "./frame_loop.mjs";
import { helloText } from "./framing.mjs";
import { decodeDc } from "./jpeg_dc.mjs";
import { Peer } from "./peer.mjs";
import { Vision } from "./vision.mjs";
import { connect } from "./websocket.mjs";

const FIRST_PAUSE_MS = 200;
const MAX_PAUSE_MS = 1000;
const USAGE = "node vision_client.mjs --connect ws://HOST:PORT --robot ID [--role vision] [--token-file FILE] [--ca FILE]";

const log = (line) => console.log(`vision: ${line}`);
const now_us = () => Math.round(performance.now() * 1000);

/** Logs a line when the state of a subject changes, not for each frame. */
class StateLog {
  constructor() {
    this.states = {};
  }

  report(subject, state, line = state) {
    if (this.states[subject] === state) return;
    this.states[subject] = state;
    log(line);
  }
}

function readOptions() {
  const text = { type: "string" };
  const given = { connect: text, robot: text, role: { type: "string", default: "vision" }, "token-file": text, ca: text };
  try {
    const { values } = parseArgs({ options: given });
    if (!/^wss?:\/\/([^/:]+|\[[0-9a-fA-F:]+\]):[0-9]+\/?$/.test(values.connect ?? "")) throw new Error("invalid --connect: expected ws://HOST:PORT or wss://HOST:PORT");
    if (!/^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$/.test(values.robot ?? "")) throw new Error("invalid --robot: expected 1 to 32 letters, digits, _ . -");
    if (!/^[a-z][a-z0-9_]{0,15}$/.test(values.role)) throw new Error("invalid --role: expected 1 to 16 lowercase letters, digits, _");
    const token = values["token-file"] && readFileSync(values["token-file"], "ascii").trim();
    return { ...values, token, ca: values.ca && readFileSync(values.ca) };
  } catch (error) {
    console.error(`error: ${error.message}\nusage: ${USAGE}`);
    return process.exit(2);
  }
}

class Client {
  constructor(options) {
    this.options = options;
    this.stateLog = new StateLog();
    this.session = randomBytes(4).toString("hex");
    this.peer = null;
    const environment = {
      decodeImage: (jpeg) => {
        const { width, height, scale, rgb } = decodeDc(jpeg);
        return { width, height, scale, data: rgb, channels: 3 };
      },
      send: (name, header, payload) => this.peer?.send(name, header, payload),
      now_us,
      pause: () => new Promise(setImmediate),
      onDecision: ({ target }) => this.stateLog.report("target", target === null ? "no target" : "target seen"),
    };
    this.frameLoop = new FrameLoop(new Vision(this.session, options.role), environment);
    this.ending = false;
  }

  /** Connect. Reconnect after each loss of the connection. */
  async run() {
    let pause_ms = FIRST_PAUSE_MS;
    while (!this.ending) {
      if (await this.connectOnce()) pause_ms = FIRST_PAUSE_MS;
      if (!this.ending) await new Promise((resume) => setTimeout(resume, pause_ms));
      pause_ms = Math.min(MAX_PAUSE_MS, pause_ms * 1.5);
    }
  }

  /** Run one connection until its end. @returns {Promise<boolean>} true if it opened */
  async connectOnce() {
    const { connect: url, robot, role } = this.options;
    let connection;
    try {
      connection = await connect(url, this.options);
    } catch (error) {
      this.stateLog.report("link", `no robot at ${url}: ${error.message}`);
      return false;
    }
    let opened = false;
    const ended = await new Promise((onEnd) => {
      const onOpen = () => {
        opened = true;
        this.stateLog.report("link", `frames from robot ${robot} at ${url}`);
      };
      const hello = helloText(robot, this.session, WANTED_CHANNELS, role);
      this.peer = new Peer(connection, { robot, hello, sendsFirst: true, onOpen, onEnd, onMessage: (packet) => this.frameLoop.onMessage(packet) });
    });
    this.peer = null;
    if (!this.ending) this.stateLog.report("link", `link ended: ${ended.reason || "no reason"} (${ended.code})`);
    return opened;
  }

  end() {
    this.ending = true;
    this.peer?.connection.close(1001, "the vision service is shutting down");
    const skipped = Object.entries(this.frameLoop.skipped).map(([reason, count]) => `${count} ${reason}`);
    log(`ended after ${this.frameLoop.answered} frames; skipped: ${skipped.join(", ") || "none"}`);
    setTimeout(() => process.exit(0), 100).unref();
  }
}

const client = new Client(readOptions());
for (const signal of ["SIGINT", "SIGTERM"]) process.once(signal, () => client.end());
log(`looking for robot ${client.options.robot} at ${client.options.connect}`);
await client.run();
