// A host to test pages against, and a line between page and host that can be cut or slowed down.
import { spawn } from "node:child_process";
import { once } from "node:events";
import net from "node:net";
import path from "node:path";
import readline from "node:readline";

const programs = process.env.PALPATE_PROGRAMS ?? path.resolve(import.meta.dirname, "../../../../target/release");

/** Starts `palpate-server host` with a page; resolves when it listens. */
export async function startHost(model, ...options) {
  const view = options.includes("--view") ? [] : ["--view", "127.0.0.1:0"];
  const args = ["host", model, "--listen", "127.0.0.1:0", ...view, "--identity", "new", "--json", ...options];
  const host = start("palpate-server", args);
  return { ...host, ...JSON.parse(await host.until((line) => line.startsWith("{"))) };
}

/** Starts a program. */
export function start(program, args) {
  const child = spawn(path.join(programs, program), args, { stdio: ["ignore", "pipe", "pipe"] });
  const lines = [];
  for (const stream of [child.stdout, child.stderr]) readline.createInterface({ input: stream }).on("line", (line) => lines.push(line));
  const ended = once(child, "exit");
  return {
    /** Resolves with the code and the signal of its end. */
    ended,
    /** The first line of its output that is one. */
    async until(is) {
      for (const end = Date.now() + 60_000; Date.now() < end; await new Promise((resolve) => setTimeout(resolve, 20))) {
        const line = lines.find(is);
        if (line !== undefined) return line;
        if (child.exitCode !== null) break;
      }
      throw new Error(`${program} did not start: ${lines.join("\n")}`);
    },
    async stop() {
      if (child.exitCode !== null) return;
      child.kill("SIGINT");
      await ended;
    },
  };
}

/** A TCP line to the host of a URL. Its URL leads to the same page. */
export async function openLine(url) {
  const to = new URL(url);
  const open = new Set();
  let isCut = false;
  let bytesPerS = Infinity;
  const server = net.createServer((near) => {
    if (isCut) return near.destroy();
    const far = net.connect(Number(to.port), to.hostname);
    for (const socket of [near, far]) {
      open.add(socket);
      socket.on("error", () => undefined);
      socket.on("close", () => {
        open.delete(socket);
        near.destroy();
        far.destroy();
      });
    }
    near.pipe(far);
    far.on("data", (data) => {
      near.write(data);
      if (bytesPerS === Infinity) return;
      far.pause();
      setTimeout(() => far.resume(), (1000 * data.length) / bytesPerS);
    });
  });
  server.listen(0, "127.0.0.1");
  await once(server, "listening");
  const by = new URL(url);
  by.port = String(server.address().port);
  return {
    url: by.href,
    cut() {
      isCut = true;
      for (const socket of open) socket.destroy();
    },
    mend() {
      isCut = false;
    },
    slow(rate) {
      bytesPerS = rate;
    },
    close() {
      this.cut();
      server.close();
    },
  };
}
