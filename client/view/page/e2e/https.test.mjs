// The page over HTTPS with the host's self-signed certificate.
import assert from "node:assert/strict";
import { once } from "node:events";
import https from "node:https";
import { after, before, test } from "node:test";
import tls from "node:tls";
import { startHost } from "./host.mjs";
import { Visitor, startBrowser } from "./visitor.mjs";

const DAY_MS = 24 * 3600 * 1000;

let host, browser;

before(async () => {
  host = await startHost("handle", "--view", "0.0.0.0:0", "--public", "sim.example");
  browser = await startBrowser("--ignore-certificate-errors");
});

after(async () => {
  await browser?.close();
  await host?.stop();
});

const port = () => Number(new URL(host.pages.spectator).port);

/** The certificate of the page, by a connection that does not check it. */
async function certificate() {
  const socket = tls.connect({ host: "127.0.0.1", port: port(), rejectUnauthorized: false });
  await once(socket, "secureConnect");
  const found = socket.getPeerX509Certificate();
  socket.destroy();
  return found;
}

/** Loads the page as a client that trusts one certificate. */
function load(ca, servername) {
  return new Promise((resolve, reject) => {
    const request = https.get({ host: "127.0.0.1", port: port(), path: "/", ca, servername }, (response) => {
      response.resume();
      response.on("end", () => resolve(response.statusCode));
    });
    request.on("error", reject);
  });
}

test("the URL names the scheme and the public host, and the certificate names both hosts for 13 days", async () => {
  assert.match(host.pages.spectator, /^https:\/\/sim\.example:/);
  assert.equal(host.is_page_self_signed, true);
  const found = await certificate();
  assert.match(found.subjectAltName, /DNS:sim\.example/);
  assert.match(found.subjectAltName, /DNS:localhost/);
  assert.equal(Date.parse(found.validTo) - Date.parse(found.validFrom), 13 * DAY_MS);
});

test("a client that pins the certificate gets the page, and one that pins another certificate does not", async () => {
  const pinned = (await certificate()).toString();
  assert.equal(await load(pinned, "sim.example"), 200);
  await assert.rejects(load(pinned, "other.example"));
  const other = await startHost("handle", "--view", "0.0.0.0:0");
  try {
    const foreign = tls.connect({ host: "127.0.0.1", port: Number(new URL(other.pages.spectator).port), rejectUnauthorized: false });
    await once(foreign, "secureConnect");
    const ca = foreign.getPeerX509Certificate().toString();
    foreign.destroy();
    await assert.rejects(load(ca, "localhost"));
  } finally {
    await other.stop();
  }
});

test("a browser joins over HTTPS", async () => {
  const url = host.pages.spectator.replace("sim.example", "127.0.0.1");
  const page = await Visitor.open(browser, url, "sue");
  await page.until("joined", (s) => s.status === "joined" && s.triangles > 100, 60);
});
