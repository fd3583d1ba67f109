/**
 * @file The viewer in a browser: shows the frames of a robot, steers at a yellow target on request, and sends STOP. Shell.
 *
 * It acknowledges a frame after drawing it, so that the robot sends as fast as the page draws and no queue grows.
 */

import { FrameLoop, WANTED_CHANNELS } from "./frame_loop.mjs";
import { PeerError, SUBPROTOCOL, helloText, pack, readHello, unpack } from "./framing.mjs";
import { OPERATOR, Vision } from "./vision.mjs";

const FIRST_PAUSE_MS = 200;
const MAX_PAUSE_MS = 1000;
const SILENCE_MS = 2000; // a robot that loses its power does not close; a status arrives ten times a second
const STOP_PERIOD_MS = 50;
const STOP_SLOW_MS = 300; // after this time the page reports that a STOP is not confirmed
const MAX_BUFFERED_BYTES = 65_536; // a browser queues without limit; above this the viewer drops commands

/** Connects one page to one robot. Calls `show(change)`: {link}, {status}, {reply}, {target, twist, age_us} or {stop}. */
export class Viewer {
  /**
   * @param {{url: string, robot: string, decodeImage: (jpeg: Uint8Array) => Promise<object>, show: (change: object) => void,
   *   token?: string, WebSocket?: typeof WebSocket}} options `decodeImage` draws an image and returns its pixels
   */
  constructor({ url, robot, decodeImage, show, token = "", WebSocket = globalThis.WebSocket }) {
    Object.assign(this, { url, robot, show, WebSocket });
    this.subprotocols = [SUBPROTOCOL, ...(token ? [`sightline.token.${token}`] : [])];
    this.session = [...crypto.getRandomValues(new Uint8Array(4))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    this.vision = new Vision(this.session, OPERATOR);
    this.frameLoop = new FrameLoop(this.vision, {
      decodeImage,
      send: (name, header, payload) => this.send(name, header, payload),
      now_us: () => Math.round(performance.now() * 1000),
      onDecision: show,
      onReply: (reply) => show({ reply }),
    });
    this.frameLoop.drives = false;
    this.pause_ms = FIRST_PAUSE_MS;
    this.socket = null;
    this.isOpen = this.stopping = this.ended = false;
  }

  /** Connect. Reconnect after each loss of the connection. */
  open() {
    const socket = new this.WebSocket(this.url, this.subprotocols);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.awaitMessage(socket);
      socket.send(this.hello());
    };
    socket.onmessage = ({ data }) => socket === this.socket && this.read(data);
    socket.onclose = ({ code, reason }) => this.onLost(socket, reason || `code ${code}`);
    // Some platforms send no close event here, and none shows the reason that the robot sent.
    socket.onerror = () => this.onLost(socket, "no answer, or a missing or wrong token after the # of the address");
    this.awaitMessage(socket);
  }

  /** Drop the connection unless a message arrives in time. */
  awaitMessage(socket) {
    clearTimeout(this.silence);
    this.silence = setTimeout(() => {
      socket.close();
      this.onLost(socket, "silent for 2 s");
    }, SILENCE_MS);
  }

  hello() {
    return helloText(this.robot, this.session, WANTED_CHANNELS, this.frameLoop.drives ? "vision" : "viewer");
  }

  read(data) {
    this.awaitMessage(this.socket);
    try {
      if (typeof data === "string") this.onHello(data);
      else this.receive(unpack(new Uint8Array(data), "", this.robot));
    } catch (error) {
      if (!(error instanceof PeerError)) throw error;
      this.socket?.close(3000, "invalid message"); // a page must not close with 1002 to 1011
      this.show({ link: error.message });
    }
  }

  onHello(text) {
    readHello(text, this.robot);
    this.isOpen = true;
    this.pause_ms = FIRST_PAUSE_MS;
    this.show({ link: "connected" });
  }

  receive(packet) {
    if (packet === null) return;
    const before = this.vision.status;
    this.frameLoop.onMessage(packet);
    const { status } = this.vision;
    if (status !== before && status !== null) this.show({ status: status.payload });
  }

  onLost(socket, reason) {
    if (this.ended || socket !== this.socket) return;
    clearTimeout(this.silence);
    this.isOpen = false;
    this.socket = null;
    this.show({ link: `no connection: ${reason}` });
    setTimeout(() => this.ended || this.open(), this.pause_ms);
    this.pause_ms = Math.min(MAX_PAUSE_MS, this.pause_ms * 1.5);
  }

  send(name, header, payload) {
    if (name === "twist" && this.stopping) return; // without commands the robot stops, even if no STOP arrives
    const urgent = name === "request";
    if (this.isOpen && (urgent || this.socket.bufferedAmount < MAX_BUFFERED_BYTES)) this.socket.send(pack(name, header, payload));
  }

  /** Drive as `vision`, or watch only. @param {boolean} drives */
  setDriving(drives) {
    this.frameLoop.drives = drives;
    this.vision.source = drives ? "vision" : OPERATOR;
    if (this.isOpen) this.socket.send(this.hello());
  }

  /** Send a request. @param {"arm"|"disarm"|"reset"} verb */
  request(verb) {
    return this.frameLoop.request(verb);
  }

  /** Send STOP every 50 ms until a status after the first one shows STOPPED and wheels at zero. */
  stop() {
    if (this.stopping) return;
    this.stopping = true;
    const since_ms = performance.now();
    let statusAtSend; // it may be older than a reset by another operator, so it confirms nothing
    const repeat = () => {
      const { status } = this.vision;
      const isLatched = statusAtSend !== undefined && status !== statusAtSend && status?.payload.state === "STOPPED";
      this.stopping = !this.ended && !(isLatched && status.payload.applied.every((speed) => speed === 0));
      if (this.ended) return;
      if (!this.stopping) {
        this.show({ stop: "STOPPED" });
        return;
      }
      if (this.isOpen && statusAtSend === undefined) statusAtSend = status;
      this.frameLoop.request("stop");
      const isSlow = !isLatched && performance.now() - since_ms > STOP_SLOW_MS;
      this.show({ stop: isSlow ? "STOP is not confirmed; cut the power by hand" : "STOP ..." });
      setTimeout(repeat, STOP_PERIOD_MS);
    };
    repeat();
  }

  close() {
    this.ended = true;
    clearTimeout(this.silence);
    this.socket?.close(1000);
  }
}

/** Return a decoder that draws an image on the canvas and returns its pixels. */
export function canvasDecoder(canvas) {
  const context = canvas.getContext("2d", { willReadFrequently: true });
  return async (jpeg) => {
    const bitmap = await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" }));
    canvas.width = bitmap.width;
    canvas.height = bitmap.height;
    context.drawImage(bitmap, 0, 0);
    bitmap.close();
    const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
    return { width: canvas.width, height: canvas.height, scale: 1, data, channels: 4 };
  };
}

/** Mark the target with a rectangle. */
export function markTarget(canvas, target) {
  if (target === null) return;
  const context = canvas.getContext("2d");
  context.strokeStyle = "#d00";
  context.strokeRect(target.x_px - target.width_px / 2, 0, target.width_px, canvas.height);
}
