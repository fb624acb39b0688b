// The page of a local client: its own replica, at local latency.
import assert from "node:assert/strict";
import fs from "node:fs";
import os from "node:os";
import path from "node:path";
import { after, before, test } from "node:test";
import { start, startHost } from "./host.mjs";
import { Visitor, pause, startBrowser } from "./visitor.mjs";

const HOLD_S = 14;
let host, browser, folder;

before(async () => {
  host = await startHost("thigh");
  browser = await startBrowser();
  folder = fs.mkdtempSync(path.join(os.tmpdir(), "palpate-"));
});

after(async () => {
  await browser?.close();
  await host?.stop();
  fs.rmSync(folder, { recursive: true });
});

/** Joins with a page; returns the client and the address of the page. */
async function join(...options) {
  const client = start("palpate-client", ["join", host.links.trainee, "--view", "127.0.0.1:0", "--forget-seat", ...options]);
  const line = await client.until((line) => line.includes("the page is at"));
  return { client, url: line.match(/http:\S+/)[0] };
}

test("the page of a client shows its own replica while its hand presses", async () => {
  const script = path.join(folder, "hold.toml");
  const way = (t_s, y) => `[[way]]\nt_s = ${t_s}\nat_mm = [0.0, ${y}, 100.0]\n`;
  const ways = [way(0, 100), way(2, 70), way(HOLD_S, 70), way(HOLD_S + 1, 100)];
  fs.writeFileSync(script, `format = "palpate-script/1"\n[tool]\nkind = "probe"\nradius_mm = 8.0\n${ways.join("")}`);
  const { client, url } = await join("--name", "ann", "--script", script, "--duration", String(HOLD_S + 4));
  const page = await Visitor.open(browser, url, "ann");
  // Poses and forces can arrive before the tissue.
  await page.until("pressed", (s) => s.status === "joined" && s.own_force_n > 0.2 && s.probe?.displacement_m != null);
  await pause(4000);
  const held = await page.state();
  assert.ok(Math.hypot(...held.probe.displacement_m) > 2e-3, `the tissue is pressed: ${held.probe.displacement_m}`);
  // The ball has a radius of 8 mm. The proxy is outside the drawn tissue, within 1 mm.
  assert.ok(held.device.force_n > 0.2 && held.proxy !== null, "a pressed device has a proxy");
  const apart_m = Math.hypot(...held.proxy.position_m.map((x, i) => x - held.device.position_m[i]));
  assert.ok(apart_m > 1e-3 && held.proxy.distance_m > 7e-3, `the proxy: ${JSON.stringify([held.device, held.proxy])}`);
  console.log(`proxy ${(1e3 * apart_m).toFixed(1)} mm from the device, ${(1e3 * held.proxy.distance_m).toFixed(1)} mm from the tissue`);
  console.log(`latency ${JSON.stringify(held.latency_ms)}; ${held.fps.toFixed(0)} fps; first picture after ${held.first_picture_ms.toFixed(0)} ms`);
  // The hand is behind the tissue of the usual view.
  await page.click("Back");
  await page.page.setViewport({ width: 1000, height: 640 });
  await pause(700);
  await page.picture("client");
  await page.click("Dark");
  await page.picture("client-dark");
  const free = await page.until("released", (s) => s.device.position_m[1] > 0.095);
  assert.deepEqual([free.device.force_n, free.proxy], [0, null], "a free device has no proxy");
  const { code } = await client.ended.then(([code]) => ({ code }));
  assert.equal(code, 0);
  await page.until("ended with the client", (s) => s.status === "ended");
});

test("the mouse is a device of the local client", async () => {
  const { client, url } = await join("--name", "bea", "--device", "pointer", "--duration", "40");
  const page = await Visitor.open(browser, url, "bea");
  await page.until("joined", (s) => s.status === "joined" && s.tools.length > 0);
  const at = async (x, y, z) => page.page.evaluate((p) => window.palpate.moveTool(p, false), [x, y, z]);
  await at(0, -0.1, 0.1);
  await page.until("there", (s) => Math.abs(s.tools[0].position_m[1] + 0.1) < 2e-3);
  for (let y = -0.1; y < -0.07; y += 1e-3) {
    await at(0, y, 0.1);
    await pause(40);
  }
  await page.until("a force of the own replica", (s) => s.own_force_n > 0.1);
  await page.picture("pointer");
  await page.close();
  client.stop();
  await client.ended;
});

test("figures of a client show the emulated delay and loss", async () => {
  const { client, url } = await join("--name", "cem", "--device", "pointer", "--duration", "60");
  const page = await Visitor.open(browser, url, "cem");
  const instructor = await Visitor.open(browser, host.pages.instructor, "ina", { width: 1280, height: 900 });
  const cem = (state) => state.participants.find((p) => p.name === "cem");
  const { id, loss } = cem(await instructor.until("together", (s) => cem(s)?.rtt_ms > 0));
  assert.ok(loss < 0.01, `loss ${loss} before`);
  await instructor.emulate(id, 100, 20);
  await instructor.until("emulated", (s) => cem(s).rtt_ms >= 200 && cem(s).loss > 0.03);
  const people = await instructor.page.$eval("#people", (people) => people.textContent);
  assert.match(people, /trainee[2-9]\d\d\u202fms · .*% loss .*emulated 100\u202fms, 20\u202f%/);
  await instructor.picture("client-emulated");
  await instructor.close();
  await page.close();
  client.stop();
  await client.ended;
});
