// A session in browsers: instructor, trainee and spectator on one host.
import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { openLine, startHost } from "./host.mjs";
import { Visitor, pause, startBrowser } from "./visitor.mjs";

let host, browser, line, instructor, trainee, spectator;

before(async () => {
  host = await startHost("thigh");
  browser = await startBrowser();
  line = await openLine(host.pages.trainee);
  instructor = await Visitor.open(browser, host.pages.instructor, "ina", { width: 1280, height: 900 });
  trainee = await Visitor.open(browser, line.url, "tom", { width: 1000, height: 640 });
  spectator = await Visitor.open(browser, host.pages.spectator, "sue");
});

after(async () => {
  await browser?.close();
  line?.close();
  await host?.stop();
});

const everyone = () => [instructor, trainee, spectator];

/** All pages show the same topology, newer than a version. */
async function agree(since) {
  const states = [];
  for (const page of everyone()) states.push(await page.settled(since));
  const hashes = new Set(states.map((s) => s.topology_hash));
  assert.equal(hashes.size, 1, `hashes differ: ${[...hashes]}`);
  return states[0];
}

const own = (state) => state.tools.find((tool) => tool.participant === state.participant);
const seat = (state, name) => state.participants.find((p) => p.name === name);

/** Moves the trainee's tool along points in mm. */
async function stroke(points, isHeld) {
  for (const point of points) {
    const at = point.map((x) => x / 1000);
    await trainee.page.evaluate((at, held) => window.palpate.moveTool(at, held), at, isHeld);
    await trainee.until("at the point", (s) => own(s) && Math.hypot(...own(s).position_m.map((x, i) => x - at[i])) < 0.002);
  }
}

let uncut, latest;

test("every page shows the tissue, the tools and the participants", async () => {
  for (const page of everyone()) {
    const state = await page.until("a tissue with three participants", (s) => s.status === "joined" && s.triangles > 1000 && s.participants.length === 3);
    assert.ok(state.nodes > 1000);
    assert.deepEqual(state.participants.map((p) => p.name).sort(), ["ina", "sue", "tom"]);
    await page.picture("1-joined");
  }
  assert.equal((await spectator.state()).role, "spectator");
  uncut = await agree(-1);
});

test("the trainee presses with the mouse, and every page sees the dent", async () => {
  await stroke([[0, -100, 100]], false);
  const { x, y } = await trainee.middle();
  await trainee.page.mouse.move(x, y);
  const pressed = async () => (await trainee.state()).own_force_n > 0.3;
  for (let notch = 0; notch < 120 && !(await pressed()); notch += 1) {
    await trainee.page.mouse.wheel({ deltaY: -60 });
    await pause(60);
  }
  const state = await trainee.until("a force", (s) => s.own_force_n > 0.3);
  const [px, py, pz] = own(state).position_m;
  assert.ok(py < -0.05, `the ball is at the surface, not inside: ${[px, py, pz]}`);
  for (const page of everyone()) await page.picture("2-pressed");
});

test("the springs of a region follow the dent on the page that asks, and on no other", async () => {
  const options = await instructor.page.$$eval("#springs option", (all) => all.map((o) => [o.value, o.textContent]));
  await instructor.page.select("#springs", options[1][0]);
  const { springs, nodes } = await instructor.until("springs", (s) => s.springs !== null);
  assert.ok(springs.count > nodes / 10 && springs.count < 13 * nodes, `${springs.count} springs, ${nodes} nodes`);
  assert.ok(!springs.isCutShort);
  assert.ok(springs.least < -0.02, `springs under the ball are compressed: ${JSON.stringify(springs)}`);
  console.log(`springs ${JSON.stringify(springs)}`);
  await pause(700);
  await instructor.page.$eval("#springs", (e) => e.scrollIntoView({ block: "center" }));
  await instructor.picture("2-springs");
  for (const page of [trainee, spectator]) assert.equal((await page.state()).springs, null);
  await stroke([[0, -110, 100]], false);
  await instructor.until("springs at rest", (s) => s.springs.least > -0.02);
  // A small region is shown during the cut, because software draws many springs slowly.
  await instructor.page.select("#springs", options[options.length - 1][0]);
  await instructor.until("springs of a small region", (s) => s.springs !== null && s.springs.count < springs.count / 4);
});

test("the trainee takes the blade from the palette and cuts", async () => {
  await stroke([[0, -110, 100]], false);
  await trainee.click("Blade");
  for (const page of everyone()) await page.until("a blade", (s) => seat(s, "tom").tool.kind === "blade");
  await stroke([[-20, -95, 100]], false);
  await stroke([[-20, -70, 100], [-10, -70, 100], [0, -70, 100], [10, -70, 100], [20, -70, 100], [20, -95, 100]], true);
  await stroke([[20, -110, 100]], false);
  const state = await agree(uncut.topology_version);
  assert.notEqual(state.topology_hash, uncut.topology_hash);
  for (const page of everyone()) await page.picture("3-cut");
  await instructor.until("springs of the cut tissue", (s) => s.springs !== null);
  await instructor.page.select("#springs", "");
  await instructor.until("no springs", (s) => s.springs === null);
});

test("the instructor freezes and continues", async () => {
  await instructor.click("Freeze all");
  for (const page of everyone()) await page.until("frozen", (s) => s.is_frozen);
  for (const page of everyone()) await page.picture("4-frozen");
  await instructor.click("Continue");
  for (const page of everyone()) await page.until("continued", (s) => !s.is_frozen);
});

test("the instructor mutes the trainee and gives the tool back", async () => {
  const { participants } = await instructor.state();
  const participant = participants.find((p) => p.name === "tom").id;
  const mute = (is_muted) => instructor.page.evaluate((act) => window.palpate.control(act), { act: "mute", participant, is_muted });
  await mute(true);
  for (const page of everyone()) await page.until("muted", (s) => seat(s, "tom").is_muted);
  await trainee.picture("5-muted");
  await mute(false);
  await trainee.until("active", (s) => !seat(s, "tom").is_muted);
});

test("undo takes the cut back and redo makes it again, with equal hashes", async () => {
  const cut = await agree(uncut.topology_version);
  await instructor.click("Undo cut");
  const undone = await agree(cut.topology_version);
  assert.equal(undone.topology_hash, uncut.topology_hash);
  for (const page of everyone()) await page.picture("6-undone");
  await instructor.click("Redo cut");
  const redone = await agree(undone.topology_version);
  latest = redone.topology_version;
  assert.equal(redone.topology_hash, cut.topology_hash);
});

test("a page that loses its connection says so and comes back in its seat", async () => {
  const { participant } = await trainee.state();
  line.cut();
  await trainee.until("disconnected", (s) => s.connection !== "open");
  await trainee.picture("7-lost");
  await instructor.until("without the trainee", (s) => !seat(s, "tom").is_connected);
  line.mend();
  const back = await trainee.until("back", (s) => s.connection === "open" && s.topology_version === latest);
  assert.equal(back.participant, participant);
});

test("a page that is loaded again keeps its blade and cuts with it", async () => {
  const { participant } = await trainee.state();
  await trainee.page.reload();
  const back = await trainee.until("back", (s) => s.status === "joined" && s.participant === participant && s.triangles > 1000);
  assert.equal(seat(back, "tom").tool.kind, "blade");
  await stroke([[-20, -110, 120], [-20, -95, 120]], false);
  await stroke([[-20, -70, 120], [0, -70, 120], [20, -70, 120], [20, -95, 120]], true);
  await stroke([[20, -110, 120]], false);
  await agree(latest);
});

test("a slow page misses pictures and delays no other", async () => {
  const slowLine = await openLine(host.pages.spectator);
  const slow = await Visitor.open(browser, slowLine.url, "slo");
  await slow.until("joined", (s) => s.triangles > 1000, 40);
  slowLine.slow(3000);
  const x = (state) => state.tools.find((t) => t.participant === seat(state, "tom").id)?.position_m[0];
  const passed = { quick: 0, slow: 0 };
  let before = {};
  for (const x_mm of [-30, 30, -30, 30]) {
    await trainee.page.evaluate((at) => window.palpate.moveTool(at, false), [x_mm / 1000, -0.11, 0.1]);
    // The motion takes 0.2 s; both pages are looked at while it lasts.
    for (let look = 0; look < 12; look += 1) {
      const now = { quick: x(await spectator.state()), slow: x(await slow.state()) };
      for (const page of ["quick", "slow"]) passed[page] += Math.abs((now[page] ?? 0) - (before[page] ?? 0));
      before = now;
      await pause(50);
    }
    await spectator.until("at the end of the motion", (s) => Math.abs(x(s) - x_mm / 1000) < 3e-3, 2);
  }
  assert.ok(passed.slow < 0.7 * passed.quick, `the slow page missed nothing: ${JSON.stringify(passed)}`);
  await slow.close();
  slowLine.close();
});

test("a wrong grant and a foreign role are refused with a sentence", async () => {
  const wrong = host.pages.trainee.replace(/grant=..../, "grant=0000");
  const page = await Visitor.open(browser, wrong, "eve");
  await page.until("refused", (s) => s.status === "refused");
  await page.picture("8-refused");
  await page.close();
  const raised = host.pages.spectator.replace("spectator", "instructor");
  const other = await Visitor.open(browser, raised, "eve");
  await other.until("refused", (s) => s.status === "refused");
  await other.close();
});

test("a trainee can not control the session", async () => {
  await trainee.page.evaluate(() => window.palpate.control({ act: "freeze", is_frozen: true }));
  await trainee.until("refused", (s) => s.notices.some((n) => n.includes("role")));
  assert.equal((await instructor.state()).is_frozen, false);
});

test("an annotation follows the tissue and its text is no markup", async () => {
  const text = "<img src=x onerror=alert(1)>";
  const { node } = (await instructor.state()).probe;
  const act = { act: "annotate", text, kind: "pin", nodes: [node, node, node], weights: [0.4, 0.3, 0.3], offset_m: [0, 0, 0] };
  await instructor.page.evaluate((act) => window.palpate.control(act), act);
  for (const page of everyone()) await page.until("annotated", (s) => s.annotations.includes(text));
  for (const page of everyone()) {
    assert.equal(await page.page.$("img[src=x]"), null);
    assert.deepEqual(page.errors.filter((e) => !/WebSocket|ERR_/.test(e)), []);
  }
  await instructor.picture("9-annotated");
});

test("an emulated network delays the trainee until the instructor ends it, and the figures show it", async () => {
  const { id } = seat(await instructor.state(), "tom");
  await instructor.emulate(id, 501, 0);
  await instructor.until("refused", (s) => s.notices.some((n) => n.includes("500 ms")));
  const before_ms = await trainee.figure("Round trip");
  await instructor.emulate(id, 150, 5);
  for (const page of everyone()) await page.until("emulated", (s) => seat(s, "tom").emulation?.delay_ms === 150);
  await instructor.until("measured", (s) => seat(s, "tom").rtt_ms >= 300);
  await trainee.until("measured", (s) => seat(s, "tom").rtt_ms >= 300);
  const people = await instructor.page.$eval("#people", (people) => people.textContent);
  assert.match(people, /tompoor/, "the quality of the connection follows the round trip");
  assert.match(people, /browser([3-9]\d\d|\d{4,})\u202fms · .*emulated 150\u202fms, 5\u202f%/);
  const during_ms = await trainee.figure("Round trip");
  assert.ok(before_ms < 300 && during_ms >= 300, `the own page shows ${before_ms} ms before and ${during_ms} ms during the emulation`);
  await instructor.picture("10-emulated");
  await trainee.picture("10-emulated");
  await instructor.emulate(id, 0, 0);
  for (const page of everyone()) await page.until("ended", (s) => seat(s, "tom").emulation === null);
  await trainee.until("measured without", (s) => seat(s, "tom").rtt_ms < 300);
});

test("a kicked trainee sees a sentence and leaves the session", async () => {
  const participant = seat(await instructor.state(), "tom").id;
  await instructor.page.evaluate((act) => window.palpate.control(act), { act: "kick", participant });
  await trainee.until("ended", (s) => s.status === "ended");
  await trainee.picture("11-kicked");
  await instructor.until("alone", (s) => !seat(s, "tom"));
});
