/**
 * @file Serve the viewer page and the modules that it imports. Shell (reads files).
 *
 * The page must come from the host and port of the robot, because a robot rejects pages of other sites.
 */

import { readFile } from "node:fs/promises";
import { admissionProblem } from "./websocket.mjs";

const MODULES = ["codec", "fields", "frame_loop", "framing", "json", "page", "proof", "viewer", "vision"];
const FILES = new Map([["/", ["viewer.html", "text/html"]], ...MODULES.map((name) => [`/${name}.mjs`, [`${name}.mjs`, "text/javascript"]])]);
const HEADERS = {
  "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'unsafe-inline'; connect-src 'self'; frame-ancestors 'none'",
  "X-Content-Type-Options": "nosniff",
  "Cache-Control": "no-store",
};

/**
 * Make the request handler.
 * @param {string} host on which the server listens @param {string} robot id
 * @returns {(request: import("node:http").IncomingMessage, response: import("node:http").ServerResponse) => Promise<void>}
 */
export function servePage(host, robot) {
  return async (request, response) => {
    const problem = admissionProblem(request.rawHeaders, host);
    const found = FILES.get(request.url.split("?")[0]);
    if (problem !== null || found === undefined || request.method !== "GET") {
      const [status, line] = problem ?? (found === undefined ? [404, "no such page; the viewer is at /"] : [405, "GET only"]);
      response.writeHead(status, { "Content-Type": "text/plain" }).end(`${line}\n`);
      return;
    }
    const [name, type] = found;
    const text = await readFile(new URL(name, import.meta.url), "utf8").catch(() => `${name} is not in this checkout`);
    response.writeHead(200, { ...HEADERS, "Content-Type": `${type}; charset=utf-8` }).end(text.replaceAll("{{robot}}", robot));
  };
}
