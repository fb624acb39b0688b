import assert from "node:assert/strict";
import { test } from "node:test";
import { endpoint } from "../src/dialer.ts";

const hash = "ab".repeat(32);

test("an_endpoint_has_the_host_of_the_page_and_the_port_of_the_description", () => {
  const found = endpoint({ port: 4433, certificate_hashes: [hash] }, "sim.example");
  assert.equal(found?.url, "https://sim.example:4433/session");
  assert.deepEqual([...found!.hashes[0]], new Array(32).fill(0xab));
});

test("other_descriptions_are_none", () => {
  for (const bad of [null, 1, {}, { port: 0, certificate_hashes: [hash] }, { port: 70000, certificate_hashes: [hash] }, { port: 4433, certificate_hashes: ["zz"] }, { port: 4433 }]) {
    assert.equal(endpoint(bad, "sim.example"), null, JSON.stringify(bad));
  }
});
