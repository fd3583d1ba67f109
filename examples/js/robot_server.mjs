/**
 * @file A robot for Node on WebSocket: images of a folder or drawn images, computed wheels. Shell.
 *
 *     node examples/js/robot_server.mjs --port 8765 --robot js1 --pictures examples/pictures
 *
 * It is one process. A robot with motors needs two, because the owner of the motors must survive a hanging network.
 */

import { randomBytes } from "node:crypto";
import { createSocket } from "node:dgram";
import { closeSync, existsSync, fsyncSync, mkdirSync, openSync, readFileSync, readdirSync, rmSync } from "node:fs";
import { homedir } from "node:os";
import { join } from "node:path";
import { createSecureContext } from "node:tls";
import { parseArgs } from "node:util";
import { readJpegSize } from "./codec.mjs";
import { DRAWN_CAMERA, ballAt, drawJpeg } from "./drawing.mjs";
import { helloText } from "./framing.mjs";
import { TICK_US } from "./limits.mjs";
import { servePage } from "./pages.mjs";
import { Peer } from "./peer.mjs";
import { Robot, WANTED_CHANNELS } from "./robot.mjs";
import { StopPort } from "./stop_port.mjs";
import { listen } from "./websocket.mjs";

const USAGE = "node robot_server.mjs --port PORT --robot ID [--host 127.0.0.1] [--pictures FOLDER] [--fps 30] [--auto-arm] [--guests] [--state-dir DIR] [--token-file FILE] [--cert FILE --key FILE]";
const STOP_AT_END_MS = 1500;
const LOOPBACK = ["127.0.0.1", "::1", "localhost"];
const ASSUMED_FOCAL = 0.75; // of the width; the camera of the folder is not calibrated

const now_us = () => Number(process.hrtime.bigint() / 1000n);

class UsageError extends Error {}

function readOptions() {
  const stateDir = join(process.env.XDG_STATE_HOME || join(homedir(), ".local", "state"), "sightline-js");
  const { values } = parseArgs({
    options: {
      host: { type: "string", default: "127.0.0.1" },
      port: { type: "string", default: "9090" },
      robot: { type: "string", default: "js1" },
      pictures: { type: "string" },
      fps: { type: "string", default: "30" },
      "auto-arm": { type: "boolean", default: false },
      guests: { type: "boolean", default: false },
      "state-dir": { type: "string", default: stateDir },
      "token-file": { type: "string" },
      cert: { type: "string" },
      key: { type: "string" },
    },
  });
  const [port, fps] = [Number(values.port), Number(values.fps)];
  if (!(Number.isInteger(port) && port >= 1 && port <= 65_535)) throw new UsageError("invalid --port: expected 1 to 65535");
  if (!(fps > 0 && fps <= 240)) throw new UsageError("invalid --fps: expected a number above 0, at most 240");
  if (!/^[A-Za-z0-9][A-Za-z0-9_.-]{0,31}$/.test(values.robot)) throw new UsageError("invalid --robot: expected 1 to 32 letters, digits, _ . -");
  if (!LOOPBACK.includes(values.host) && !values["token-file"]) throw new UsageError(`--host ${values.host} accepts network clients without a token; pass --token-file FILE`);
  if (!values.cert !== !values.key) throw new UsageError("--cert and --key need each other; pass both");
  const tls = values.cert ? readTls(values) : undefined;
  return { ...values, port, fps, tls, token: values["token-file"] && readToken(values["token-file"]) };
}

function readOption(name, path, read = readFileSync) {
  try {
    return read(path);
  } catch (error) {
    throw new UsageError(`${name} ${path}: ${error.message}`);
  }
}

function readTls({ cert, key }) {
  const tls = { cert: readOption("--cert", cert), key: readOption("--key", key) };
  try {
    createSecureContext(tls);
  } catch (error) {
    throw new UsageError(`--cert ${cert}, --key ${key}: ${error.message}`);
  }
  return tls;
}

function readToken(path) {
  const token = readOption("--token-file", path).toString("ascii").trim();
  if (!/^[A-Za-z0-9_-]{16,128}$/.test(token)) throw new UsageError(`--token-file ${path}: invalid token; expected 16 to 128 of A-Z a-z 0-9 _ -`);
  return token;
}

function readImages(folder) {
  const names = readdirSync(folder).filter((name) => /\.jpe?g$/i.test(name)).sort();
  if (names.length === 0) throw new Error("the folder contains no .jpg file");
  const images = names.map((name) => new Uint8Array(readFileSync(join(folder, name))));
  readJpegSize(images[0]); // rejects a file that is not a JPEG
  return images;
}

/** Open a camera of the images of a folder, or of drawn images: `read(pose, t_us)` returns a JPEG; `model`: its CameraModel. */
function openCamera(folder) {
  if (folder === undefined) {
    const start_us = now_us();
    let count = 0;
    return { model: DRAWN_CAMERA, read: (pose, t_us) => drawJpeg(pose, ballAt(t_us - start_us), count++) };
  }
  const images = readOption("--pictures", folder, readImages);
  const { width_px, height_px } = readJpegSize(images[0]);
  const focal_px = ASSUMED_FOCAL * width_px;
  const model = { width_px, height_px, fx_px: focal_px, fy_px: focal_px, cx_px: width_px / 2, cy_px: height_px / 2, calibrated: false };
  let next = 0;
  return { model, read: () => images[next++ % images.length] };
}

/** The STOP latch on disk: a file that exists while the robot is stopped. */
class Latch {
  constructor(folder, robot) {
    mkdirSync(folder, { recursive: true });
    this.folder = folder;
    this.path = join(folder, `${robot}.stopped`);
    this.isSet = existsSync(this.path);
  }

  store(stopped) {
    if (stopped === this.isSet) return;
    mkdirSync(this.folder, { recursive: true }); // it may have been removed since the start
    if (stopped) closeSync(openSync(this.path, "w"));
    else rmSync(this.path, { force: true });
    const folder = openSync(this.folder, "r");
    fsyncSync(folder);
    closeSync(folder);
    this.isSet = stopped;
  }
}

class Server {
  constructor(options) {
    this.options = options;
    this.camera = openCamera(options.pictures);
    this.latch = new Latch(options["state-dir"], options.robot);
    const session = randomBytes(4).toString("hex");
    const { pictures } = options;
    const limits = { autoArm: options["auto-arm"], guests: options.guests, needsProof: options.token !== undefined };
    this.robot = new Robot({ session, fps: options.fps, camera: this.camera.model, live: pictures === undefined, limits, stopped: this.latch.isSet });
    this.hello = helloText(options.robot, session, WANTED_CHANNELS);
    this.peers = new Set();
    this.loggedState = this.robot.gate.state;
  }

  async run() {
    const { host, port, robot, pictures, tls, token } = this.options;
    this.server = await listen({
      host, port, tls, token, onConnection: (connection) => this.onConnection(connection), onPage: servePage(host, robot),
    });
    await this.openStopPort(host, Math.min(port + 1, 65_535));
    const s = tls ? "s" : "";
    this.log(`on ws${s}://${host}:${port}, session ${this.robot.session}, camera ${pictures ?? "drawn"}; viewer at http${s}://${host}:${port}/`);
    if (this.latch.isSet) this.log("STOPPED (STOP was set before the restart)");
    this.nextTick_us = this.nextCapture_us = now_us();
    this.tick();
    this.capture();
  }

  /** Accept STOP by UDP. Without the port STOP needs the link, so a failure does not end the robot. */
  openStopPort(host, port) {
    const stops = new StopPort(this.options.robot, this.robot.gate, randomBytes(16));
    const socket = createSocket(host.includes(":") ? "udp6" : "udp4");
    const opened = new Promise((resolve) => socket.once("listening", resolve).once("error", resolve));
    socket.on("error", (error) => this.log(`STOP port ${host}:${port}/udp: ${error.message}; STOP needs the link`));
    socket.on("message", (data, sender) => {
      if (!stops.onDatagram(data)) return;
      this.showState(); // stores the latch before the answer
      socket.send(stops.answer(data, this.latch.isSet), sender.port, sender.address, () => {}); // the sender repeats a lost one
    });
    socket.bind(port, host);
    return opened;
  }

  log(line) {
    console.log(`robot ${this.options.robot}: ${line}`);
  }

  onConnection(connection) {
    const onEnd = () => this.peers.delete(peer);
    const peer = new Peer(connection, {
      robot: this.options.robot, hello: this.hello, sendsFirst: false, onMessage: (packet) => this.onMessage(packet, peer), onEnd,
    });
    this.peers.add(peer);
  }

  onMessage(packet, from) {
    const at_us = now_us();
    if (this.robot.onMessage(packet, at_us)) {
      for (const peer of this.peers) if (peer !== from) peer.relay(packet);
    }
    this.showState();
    this.publish(this.robot.takeReplies(at_us));
  }

  publish(publications) {
    for (const { name, header, payload } of publications) {
      for (const peer of this.peers) peer.send(name, header, payload);
    }
  }

  /** Tick at absolute 20 ms deadlines. `status` reports the latest tick. */
  tick() {
    const at_us = now_us();
    this.robot.tickLateMax_us = Math.max(this.robot.tickLateMax_us, at_us - this.nextTick_us);
    this.nextTick_us = Math.max(this.nextTick_us + TICK_US, at_us);
    this.publish(this.robot.tick(at_us));
    this.showState();
    setTimeout(() => this.tick(), (this.nextTick_us - now_us()) / 1000);
  }

  /** Capture at the rate of the camera. A frame is sent at its capture or never. */
  capture() {
    const at_us = now_us();
    this.nextCapture_us = Math.max(this.nextCapture_us + this.robot.stream.interval_us, at_us);
    const wanted = [...this.peers].some((peer) => peer.wants.has("frame"));
    if (wanted && this.robot.mayCapture(at_us)) {
      const frame = this.robot.onImage(this.camera.read(this.robot.pose, at_us), at_us, now_us());
      if (frame !== null) this.publish([frame]);
    }
    setTimeout(() => this.capture(), (this.nextCapture_us - now_us()) / 1000);
  }

  /** Log each change of state. The latch is on disk before a peer receives the state. */
  showState() {
    const { state, reason } = this.robot.gate;
    const [logged, driving] = [this.loggedState, ["ACTIVE", "DEGRADED"]];
    if (state === logged) return;
    this.loggedState = state;
    try {
      this.latch.store(state === "STOPPED");
    } catch (error) {
      this.log(`${state} is not stored for a restart: ${error.message}; repair --state-dir`);
    }
    if (!(driving.includes(state) && driving.includes(logged))) this.log(`${state} (${reason})`);
  }

  /** Stop the wheels, then close the connections. */
  end() {
    this.robot.gate.disarm("shutting down");
    setTimeout(() => process.exit(0), STOP_AT_END_MS);
    const poll = setInterval(() => {
      if (!this.robot.isAtRest) return;
      clearInterval(poll);
      this.server.closeAll("the robot is shutting down");
      setTimeout(() => process.exit(0), 50);
    }, 20);
  }
}

try {
  const server = new Server(readOptions());
  for (const signal of ["SIGINT", "SIGTERM", "SIGHUP"]) process.once(signal, () => server.end());
  await server.run();
} catch (error) {
  const usage = error instanceof UsageError || String(error.code).startsWith("ERR_PARSE_ARGS");
  const busy = error.code === "EADDRINUSE" ? "the port is in use; end its process or pass another --port" : error.message;
  console.error(`error: ${busy}${usage ? `\nusage: ${USAGE}` : ""}`);
  process.exit(usage ? 2 : 4);
}
