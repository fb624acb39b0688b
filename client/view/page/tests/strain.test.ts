import assert from "node:assert/strict";
import { test } from "node:test";
import { STRAIN_MAX, strainColour, strainLight } from "../src/strain.ts";

test("compression_is_blue_rest_grey_and_stretch_red_and_both_saturate", () => {
  const [r, g, b] = strainColour(0);
  assert.ok(r === g && g === b);
  const compressed = strainColour(-STRAIN_MAX);
  const stretched = strainColour(STRAIN_MAX);
  assert.ok(compressed[2] > 2 * compressed[0] && stretched[0] > 2 * stretched[2]);
  assert.deepEqual(strainColour(-9), compressed);
  assert.deepEqual(strainColour(9), stretched);
  assert.ok(strainColour(0.1)[0] > r && strainColour(-0.1)[2] > b);
});

test("light_of_a_strain_is_linear", () => {
  assert.deepEqual(strainLight(0), [78, 78, 78], "grey of 150 has 30.5 % of the light of white");
  const light = strainLight(STRAIN_MAX);
  strainColour(STRAIN_MAX).forEach((c, k) => assert.ok(light[k] < c));
});
