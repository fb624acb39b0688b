// Pages by WebTransport and by WebSocket on one host.
import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { openLine, startHost } from "./host.mjs";
import { Visitor, startBrowser } from "./visitor.mjs";

let host, browser;

before(async () => {
  host = await startHost("thigh");
  browser = await startBrowser();
});

after(async () => {
  await browser?.close();
  await host?.stop();
});

/** The same page with the WebSocket forced. */
const socketOf = (url) => url.replace("/#", "/?transport=websocket#");
const own = (state) => state.tools.find((tool) => tool.participant === state.participant);

async function joined(url, name, size) {
  const page = await Visitor.open(browser, url, name, size);
  await page.until("joined", (s) => s.status === "joined" && s.triangles > 1000);
  return page;
}

test("a page uses WebTransport, and a WebSocket if its address asks for it", async () => {
  const page = await joined(host.pages.spectator, "wen");
  assert.equal((await page.state()).transport, "WebTransport");
  const shown = await page.page.$eval("#figures", (element) => element.textContent);
  assert.match(shown, /TransportWebTransport/);
  const other = await joined(socketOf(host.pages.spectator), "sue");
  assert.equal((await other.state()).transport, "WebSocket");
  assert.deepEqual(page.errors, []);
  await page.close();
  await other.close();
});

test("pages of both transports see the same press and the same cut", async () => {
  const trainee = await joined(host.pages.trainee, "tom", { width: 1000, height: 640 });
  const watcher = await joined(socketOf(host.pages.spectator), "sue");
  assert.equal((await trainee.state()).transport, "WebTransport");
  const stroke = async (points, isHeld) => {
    for (const point of points) {
      const at = point.map((x) => x / 1000);
      await trainee.page.evaluate((at, held) => window.palpate.moveTool(at, held), at, isHeld);
      await trainee.until("at the point", (s) => own(s) && Math.hypot(...own(s).position_m.map((x, i) => x - at[i])) < 0.002);
    }
  };
  await stroke([[0, -100, 100], [0, -75, 100]], false);
  await trainee.until("a force", (s) => s.own_force_n > 0.05);
  await watcher.until("the tool", (s) => s.tools.length > 0 && s.tools[0].position_m[1] > -0.08);
  await stroke([[0, -110, 100]], false);
  await trainee.click("Blade");
  await trainee.until("a blade", (s) => s.participants.find((p) => p.name === "tom").tool.kind === "blade");
  await stroke([[-20, -95, 100]], false);
  await stroke([[-20, -70, 100], [-10, -70, 100], [0, -70, 100], [10, -70, 100], [20, -70, 100], [20, -95, 100]], true);
  await stroke([[20, -110, 100]], false);
  const states = [];
  for (const page of [trainee, watcher]) states.push(await page.settled(0));
  assert.equal(states[0].topology_hash, states[1].topology_hash);
  assert.equal(states[0].triangles, states[1].triangles);
  await trainee.close();
  await watcher.close();
});

test("a page from another port than the host's own uses a WebSocket", async () => {
  const line = await openLine(host.pages.spectator);
  const page = await joined(line.url, "lin");
  assert.equal((await page.state()).transport, "WebSocket");
  await page.close();
  line.close();
});

test("a wrong grant is refused with a sentence, and a removed participant sees one, by WebTransport", async () => {
  const eve = await Visitor.open(browser, host.pages.trainee.replace(/grant=..../, "grant=0000"), "eve");
  const refused = await eve.until("refused", (s) => s.status === "refused");
  assert.equal(refused.transport, "WebTransport");
  await eve.close();
  const instructor = await joined(host.pages.instructor, "ina");
  const spectator = await joined(host.pages.spectator, "zoe");
  const zoe = (state) => state.participants.find((p) => p.name === "zoe");
  const { id } = zoe(await instructor.until("two", (s) => zoe(s) !== undefined));
  await instructor.page.evaluate((act) => window.palpate.control(act), { act: "kick", participant: id });
  await spectator.until("ended", (s) => s.status === "ended");
  await spectator.close();
  await instructor.close();
});

test("a page that reloads returns to its seat by WebTransport", async () => {
  const page = await joined(host.pages.trainee, "ret");
  const { participant } = await page.state();
  await page.page.reload();
  const back = await page.until("back", (s) => s.connection === "open" && s.participant !== null && s.triangles > 1000);
  assert.equal(back.transport, "WebTransport");
  assert.equal(back.participant, participant);
  await page.close();
});
