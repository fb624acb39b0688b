// The instructor's console by the keyboard alone.
import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { startHost } from "./host.mjs";
import { Visitor, startBrowser } from "./visitor.mjs";

let host, browser, instructor, trainee;
const own = (state) => state.tools.find((tool) => tool.participant === state.participant);
const tom = (state) => state.participants.find((p) => p.name === "tom");

before(async () => {
  host = await startHost("thigh");
  browser = await startBrowser();
  trainee = await Visitor.open(browser, host.pages.trainee, "tom");
  instructor = await Visitor.open(browser, host.pages.instructor, "ina", { width: 1280, height: 720 });
  for (const page of [trainee, instructor]) await page.until("joined", (s) => s.status === "joined" && s.triangles > 1000 && s.participants.length === 2);
});

after(async () => {
  await browser?.close();
  await host?.stop();
});

const press = (key) => instructor.page.keyboard.press(key);

test("the tabulator and Enter freeze and continue, and the focus stays on the button", async () => {
  await instructor.page.bringToFront();
  await instructor.tabTo("Go to the session");
  await instructor.picture("keyboard-1-skip");
  await press("Enter");
  const focused = () => instructor.page.evaluate(() => document.activeElement.textContent);
  assert.equal(await focused(), "Freeze all");
  await instructor.picture("keyboard-2-freeze");
  await press("Enter");
  await instructor.until("frozen", (s) => s.is_frozen);
  assert.equal(await focused(), "Continue");
  await press("Enter");
  await instructor.until("continued", (s) => !s.is_frozen);
});

test("undo keeps the focus when no cut is left, and does nothing then", async () => {
  await trainee.page.evaluate(() => window.palpate.moveTool([0, -0.11, 0.1], false));
  await trainee.until("placed", (s) => own(s) && Math.abs(own(s).position_m[1] + 0.11) < 2e-3);
  await trainee.page.keyboard.press("2");
  await trainee.until("a blade", (s) => tom(s).tool.kind === "blade");
  const ways = [[-20, -95, false], [-20, -70, true], [0, -70, true], [20, -70, true], [20, -95, true], [20, -110, false]];
  for (const [x, y, isHeld] of ways) {
    const at = [x / 1000, y / 1000, 0.1];
    await trainee.page.evaluate((at, held) => window.palpate.moveTool(at, held), at, isHeld);
    await trainee.until("at the point", (s) => own(s) && Math.hypot(...own(s).position_m.map((v, i) => v - at[i])) < 2e-3);
  }
  const cut = await instructor.settled(0);
  await instructor.tabTo("Undo cut", 1);
  await instructor.page.waitForFunction(() => document.activeElement.getAttribute("aria-disabled") === "false");
  await press("Enter");
  await instructor.until("undone", (s) => s.topology_version === cut.topology_version + 1);
  await instructor.page.waitForFunction(() => document.activeElement.getAttribute("aria-disabled") === "true");
  assert.equal(await instructor.page.evaluate(() => document.activeElement.textContent), "Undo cut");
  await press("Enter");
  await instructor.tabTo("Redo cut", 1);
  await instructor.picture("keyboard-3-undone");
  const { topology_version, notices } = await instructor.state();
  assert.deepEqual([topology_version, notices], [cut.topology_version + 1, []]);
});

test("the tabulator and Enter mute a trainee", async () => {
  await instructor.tabTo("Act on tom");
  await press("Enter");
  await instructor.tabTo("Mute", 1);
  await instructor.picture("keyboard-4-mute");
  await press("Enter");
  await instructor.until("muted", (s) => tom(s).is_muted);
  assert.equal(await instructor.page.evaluate(() => document.activeElement.textContent), "Unmute");
  await press("Enter");
  await instructor.until("active", (s) => !tom(s).is_muted);
});
