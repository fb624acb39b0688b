// A page in a browser, with what the tests ask of it.
import assert from "node:assert/strict";
import fs from "node:fs";
import path from "node:path";
import puppeteer from "puppeteer-core";

const pictures = process.env.PALPATE_PICTURES ?? path.join(import.meta.dirname, "pictures");

/** Starts the browser; software rendering, because test machines have no graphics card. */
export async function startBrowser(...flags) {
  fs.mkdirSync(pictures, { recursive: true });
  return puppeteer.launch({
    executablePath: process.env.PALPATE_BROWSER ?? "/usr/bin/chromium",
    headless: true,
    args: ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", ...flags],
  });
}

export const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

export class Visitor {
  constructor(page, name) {
    this.page = page;
    this.name = name;
    this.errors = [];
  }

  /** Opens a page at a URL under a name. */
  static async open(browser, url, name, size = { width: 640, height: 360 }) {
    const context = await browser.createBrowserContext();
    const page = await context.newPage();
    const visitor = new Visitor(page, name);
    page.on("pageerror", (error) => visitor.errors.push(error.message));
    page.on("console", (message) => {
      if (message.type() === "error") visitor.errors.push(message.text());
    });
    await page.setViewport(size);
    await page.goto(`${url}&name=${name}`);
    return visitor;
  }

  /** What the page shows, as JSON. */
  async state() {
    return this.page.evaluate(() => window.palpate.state());
  }

  /** The state once the topology is newer than a version and no further part of a stroke follows. */
  async settled(since) {
    let state = await this.until(`after version ${since}`, (s) => s.topology_version > since);
    for (let version = -1; version !== state.topology_version; state = await this.state()) {
      version = state.topology_version;
      await pause(800);
    }
    return state;
  }

  /** Waits until the page shows a state; returns it. */
  async until(what, is, seconds = 20) {
    let state;
    for (const end = Date.now() + 1000 * seconds; Date.now() < end; await pause(50)) {
      state = await this.state();
      if (is(state)) return state;
    }
    await this.picture(`failed-${this.name}`);
    assert.fail(`${this.name}: not ${what} after ${seconds} s; the page shows ${JSON.stringify(state)}`);
  }

  /** Keeps a picture of the page. */
  async picture(step) {
    await this.page.bringToFront();
    await this.page.screenshot({ path: path.join(pictures, `${step}-${this.name}.png`) });
  }

  /** Clicks a control by its visible text or label, when it is enabled. */
  async click(text) {
    const isEnabled = (element) => element.getAttribute("aria-disabled") !== "true";
    await this.page.locator(`::-p-aria([name="${text}"])`).filter(isEnabled).setTimeout(5000).click();
  }

  /** Goes to a control by the tabulator key alone. The focus on it must be visible. */
  async tabTo(text, most = 12) {
    const seen = [];
    for (let count = 0; count < most; count += 1) {
      await this.page.keyboard.press("Tab");
      const focus = await this.page.evaluate(() => {
        const element = document.activeElement;
        const { outlineStyle, outlineWidth } = getComputedStyle(element);
        const { top, bottom, left, right } = element.getBoundingClientRect();
        const isInside = top >= 0 && left >= 0 && bottom <= innerHeight && right <= innerWidth;
        return { name: element.getAttribute("aria-label") ?? element.textContent.trim(), outlineStyle, outlineWidth, isInside };
      });
      seen.push(focus.name);
      if (focus.name !== text) continue;
      assert.ok(focus.outlineStyle === "solid" && Number.parseFloat(focus.outlineWidth) >= 2 && focus.isInside, `${text}: ${JSON.stringify(focus)}`);
      return;
    }
    assert.fail(`the tabulator does not lead to ${text}: ${JSON.stringify(seen)}`);
  }

  /** The number of a row of the figures; NaN while it is unknown. */
  async figure(name) {
    const find = (list, name) => [...list.querySelectorAll("dt")].find((term) => term.textContent === name)?.nextElementSibling.textContent;
    return Number.parseFloat((await this.page.$eval("#figures dl", find, name)) ?? "");
  }

  /** Emulates a network for a participant, by the fields of the console. */
  async emulate(participant, delay_ms, loss_percent) {
    await this.page.evaluate(
      (id, values) => {
        for (const [name, value] of Object.entries(values)) document.getElementById(`emulated-${name}-${id}`).value = value;
        document.getElementById(`emulated-delay-${id}`).closest(".row").querySelector("button").click();
      },
      participant,
      { delay: String(delay_ms), loss: String(loss_percent) },
    );
  }

  /** The middle of the picture, in pixels. */
  async middle() {
    const box = await (await this.page.$("canvas")).boundingBox();
    return { x: box.x + box.width / 2, y: box.y + box.height / 2 };
  }

  async close() {
    await this.page.browserContext().close();
  }
}
