// Invitations: created in the console, used by their address in other pages, and revoked.
import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { startHost } from "./host.mjs";
import { Visitor, pause, startBrowser } from "./visitor.mjs";

/** The shortest lifetime of an invitation, ms. */
const LIFETIME_MIN_MS = 60_000;
let host, browser, instructor, short;

before(async () => {
  host = await startHost("handle");
  browser = await startBrowser();
  instructor = await Visitor.open(browser, host.pages.instructor, "ina", { width: 1280, height: 900 });
  await instructor.until("joined", (s) => s.status === "joined", 60);
  // It expires while the other tests run.
  short = await invite({ role: "trainee", minutes: 1, isSingleUse: false });
  short.expires_ms = Date.now() + LIFETIME_MIN_MS;
});

after(async () => {
  await browser?.close();
  await host?.stop();
});

/** Creates an invitation in the console. Returns its number and addresses. */
async function invite({ role, name = "", minutes, isSingleUse }) {
  const known = new Set((await instructor.state()).invitations.map((i) => i.id));
  const { page } = instructor;
  await page.select("#invite-role", role);
  await page.select("#invite-unit", "60");
  await page.$eval("#invite-name", (field, name) => (field.value = name), name);
  await page.$eval("#invite-lifetime", (field, minutes) => (field.value = minutes), String(minutes));
  await page.$eval("#invite-single", (box, isSet) => (box.checked = isSet), isSingleUse);
  await instructor.click("Invite");
  const state = await instructor.until("invited", (s) => s.invitations.some((i) => !known.has(i.id)));
  const { id } = state.invitations.find((i) => !known.has(i.id));
  await page.waitForSelector(`svg[aria-label="QR code of invitation ${id}"]`);
  const value = (selector) => page.$eval(selector, (field) => field.value);
  return { id, url: await value("#invitation-url"), link: await value("#invitation-link") };
}

const refused = (page) => page.until("refused", (s) => s.status === "refused");
const card = (page) => page.page.$eval("#card-text", (text) => text.textContent);

test("a single-use invitation admits one page, under its name, and no second one", async () => {
  const { id, url, link } = await invite({ role: "trainee", name: "tom", minutes: 5, isSingleUse: true });
  assert.match(link, /^palpate:\/\/.*\/trainee\?cert=[0-9a-f]{64}&grant=[0-9a-f]{32}$/);
  assert.ok(url.endsWith("&name=tom"));
  const rows = await instructor.page.$$eval(".invited", (all) => all.map((row) => [row.textContent, row.querySelector(".role").textContent]));
  assert.match(rows.find(([text]) => text.startsWith(`${id}:`))[1], /^[45]\u202fmin/);
  await instructor.picture("invitation");
  const plain = url.replace(/&name=.*/, "");
  const stranger = await Visitor.open(browser, plain, "eve");
  await refused(stranger);
  assert.match(await card(stranger), /name "tom"/);
  await stranger.close();
  const trainee = await Visitor.open(browser, plain, "tom");
  const state = await trainee.until("joined", (s) => s.status === "joined", 60);
  assert.equal(state.role, "trainee");
  await instructor.until("used up", (s) => !s.invitations.some((i) => i.id === id));
  assert.equal(await instructor.page.$("#invitation-url"), null, "the addresses of a used invitation are hidden");
  const second = await Visitor.open(browser, plain, "tim");
  await refused(second);
  assert.match(await card(second), /used/);
  await second.close();
  await trainee.close();
});

test("a revoked invitation admits nobody, and its page does not come back", async () => {
  const { id, url } = await invite({ role: "spectator", minutes: 1, isSingleUse: false });
  const first = await Visitor.open(browser, url, "sue");
  await first.until("joined", (s) => s.status === "joined", 60);
  await instructor.click(`Revoke invitation ${id}`);
  await instructor.until("revoked", (s) => !s.invitations.some((i) => i.id === id));
  await first.page.reload();
  await refused(first);
  assert.match(await card(first), /revoked/);
  await first.close();
});

test("only the instructor's page receives addresses, and a lifetime out of range is not sent", async () => {
  const spectator = await Visitor.open(browser, host.pages.spectator, "sam");
  await spectator.until("joined", (s) => s.status === "joined", 60);
  const act = { act: "invite", role: "instructor", name: null, lifetime_s: 60, is_single_use: false };
  await spectator.page.evaluate((act) => window.palpate.control(act), act);
  await spectator.until("refused", (s) => s.notices.some((n) => n.includes("role")));
  assert.equal(await spectator.page.$("#invitation-url"), null);
  const { id } = await invite({ role: "trainee", minutes: 60, isSingleUse: true });
  await spectator.until("informed", (s) => s.invitations.some((i) => i.id === id));
  assert.equal(await spectator.page.$("#invitation-url"), null);
  await instructor.page.$eval("#invite-lifetime", (field) => (field.value = "50000"));
  const before = (await instructor.state()).invitations.length;
  await instructor.click("Invite");
  assert.ok(!(await instructor.page.$eval("#invite-lifetime", (field) => field.validity.valid)));
  assert.equal((await instructor.state()).invitations.length, before);
  assert.deepEqual(instructor.errors, []);
  await spectator.close();
});

test("an expired invitation is refused with a sentence, and the console no longer lists it", async () => {
  await pause(short.expires_ms - Date.now() + 500);
  const late = await Visitor.open(browser, short.url, "lea");
  await refused(late);
  assert.equal(await card(late), "The invitation has expired; ask the instructor for a new one");
  await late.picture("expired");
  const rows = await instructor.page.$$eval(".invited", (all) => all.filter((row) => !row.hidden).map((row) => row.textContent));
  assert.ok(rows.length > 0 && !rows.some((row) => row.startsWith(`${short.id}:`)), `the console lists ${JSON.stringify(rows)}`);
  await late.close();
});
