import assert from "node:assert/strict";
import { test } from "node:test";
import { ClockEstimate } from "../src/clock.ts";
import { Retry } from "../src/retry.ts";

test("the_fastest_round_trip_gives_the_offset", () => {
  const clock = new ClockEstimate();
  const ahead_us = 5_000_000;
  const ping = (sent: number, up: number, down: number): void => clock.add(sent, sent + up + down, 1000 * (sent + up) + ahead_us);
  assert.equal(clock.offset_us(), null);
  for (let i = 0; i < 8; i++) ping(500 * i, i === 3 ? 10 : 80, i === 3 ? 10 : 20);
  assert.equal(clock.offset_us(), ahead_us);
  assert.equal(clock.rtt_ms(), 100);
});

test("old_round_trips_are_forgotten", () => {
  const clock = new ClockEstimate();
  clock.add(0, 1, 500);
  for (let i = 1; i < 20; i++) clock.add(1000 * i, 1000 * i + 10, 1000 * (1000 * i + 5) + 300);
  assert.equal(clock.offset_us(), 300);
});

test("attempts_double_their_wait_up_to_four_seconds_within_a_minute", () => {
  const retry = new Retry();
  let now = 0;
  const waits: number[] = [];
  for (let wait = retry.next(now); wait !== null; wait = retry.next(now)) {
    waits.push(wait);
    now += wait;
  }
  assert.deepEqual(waits.slice(0, 6), [250, 500, 1000, 2000, 4000, 4000]);
  assert.ok(now > 55_000 && now <= 60_000);
  assert.equal(retry.secondsLeft(now), Math.ceil((60_000 - now) / 1000));
});
