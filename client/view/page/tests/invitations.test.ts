import assert from "node:assert/strict";
import { test } from "node:test";
import { remaining } from "../src/invitations.ts";
import { modules } from "../src/qr.ts";

test("remaining_time_is_in_its_largest_units_and_ends", () => {
  const s = 1e6;
  assert.equal(remaining(0), null);
  assert.equal(remaining(-s), null);
  assert.equal(remaining(0.1 * s), "1\u202fs");
  assert.equal(remaining(61 * s), "1\u202fmin 1\u202fs");
  assert.equal(remaining(3 * 3600 * s), "3\u202fh 0\u202fmin");
  assert.equal(remaining(30 * 86_400 * s), "30\u202fd 0\u202fh");
});

test("code_has_finder_patterns_in_three_corners_and_a_quiet_zone", () => {
  const { path, width } = modules("http://192.168.1.20:8080/#role=trainee&grant=0123456789abcdef0123456789abcdef");
  const dark = new Set([...path.matchAll(/M(\d+) (\d+)h1v1h-1z/g)].map((m) => `${m[1]},${m[2]}`));
  const at = (x: number, y: number): boolean => dark.has(`${x},${y}`);
  const count = width - 8;
  assert.equal((count - 17) % 4, 0);
  for (const [x, y] of [[4, 4], [4 + count - 7, 4], [4, 4 + count - 7]]) {
    for (let i = 0; i < 7; i += 1) {
      assert.ok(at(x + i, y) && at(x + i, y + 6) && at(x, y + i) && at(x + 6, y + i));
      assert.ok(at(x + 3, y + 3) && !at(x + 1, y + 1) && !at(x + 5, y + 5));
    }
  }
  for (const place of dark) {
    const [x, y] = place.split(",").map(Number);
    assert.ok(Math.min(x, y) >= 4 && Math.max(x, y) < 4 + count);
  }
});
