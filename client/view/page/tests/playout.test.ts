import assert from "node:assert/strict";
import { test } from "node:test";
import type { Shape, ToolPose, Tools } from "../src/messages.ts";
import { Playout, withReaction } from "../src/playout.ts";

const PERIOD_MS = 20;

function shape(number: number, time_ms: number, z: number[], nodes: number[] | null = null, version = 1): Shape {
  return {
    kind: "shape",
    version,
    number,
    time_us: 1000 * time_ms,
    solved_ms: time_ms,
    nodes: nodes === null ? null : Uint32Array.from(nodes),
    displacements: Float32Array.from(z.flatMap((value) => [0, 0, value])),
    reactions: [],
  };
}

function frame(time_ms: number, x: number): Tools {
  const pose: ToolPose = {
    participant: 1, is_active: true, is_device: false, is_proxy: false, buttons: 0,
    position: [x, 0, 0], rotation: [0, 0, 0, 1], force: [0, 0, 0],
  };
  return { kind: "tools", delay_ms: 50, time_us: 1000 * time_ms, sent_us: 0, tools: [pose] };
}

/** Plays shapes of node 0, whose displacement is its time in s, that arrive with a jitter; returns displayed times in ms. */
function play(jitter_ms: (i: number) => number): number[] {
  const playout = new Playout();
  playout.addSurface(1, 2);
  const arrivals = Array.from({ length: 200 }, (_, i) => ({ at: i * PERIOD_MS + 100 + jitter_ms(i), i }));
  const times: number[] = [];
  for (let now = 100; now < 4000; now += 16) {
    while (arrivals.length > 0 && arrivals[0].at <= now) {
      const { at, i } = arrivals.shift()!;
      playout.addShape(shape(i, i * PERIOD_MS, [(i * PERIOD_MS) / 1000, 0], i === 0 ? null : [0, 1]), at);
    }
    playout.advance(now);
    if (playout.time_s !== null && now > 1000) {
      times.push(1000 * playout.time_s);
      assert.ok(Math.abs(playout.shown[2] - playout.time_s) < 1e-6, "the shape is that of the displayed time");
    }
  }
  return times;
}

test("displayed_time_runs_one_period_behind_the_newest_shape", () => {
  const times = play(() => 0);
  times.forEach((time, i) => {
    const now = 1012 + 16 * i;
    assert.ok(Math.abs(now - 100 - PERIOD_MS - time) < 2, `${time} at ${now}`);
  });
});

test("displayed_time_runs_evenly_under_jitter_and_never_back", () => {
  const times = play((i) => (i * 7919) % 12);
  for (let i = 1; i < times.length; i++) {
    const step = times[i] - times[i - 1];
    assert.ok(step >= 0, "never back");
    assert.ok(step > 16 * 0.8 && step < 16 * 1.2, `step of ${step} ms in 16 ms`);
  }
});

test("a_gap_of_numbers_waits_for_a_full_shape", () => {
  const playout = new Playout();
  playout.addSurface(1, 1);
  assert.ok(playout.addShape(shape(1, 0, [1]), 0));
  assert.ok(playout.addShape(shape(2, 20, [2], [0]), 20));
  assert.ok(!playout.addShape(shape(4, 60, [4], [0]), 60));
  assert.ok(playout.isWaiting);
  assert.ok(!playout.addShape(shape(5, 80, [5], [0]), 80));
  assert.ok(playout.addShape(shape(6, 100, [6]), 100));
  for (let now = 100; now < 400; now += 10) playout.advance(now);
  assert.equal(playout.shown[2], 6);
});

test("only_moved_nodes_are_reported", () => {
  const playout = new Playout();
  playout.addSurface(1, 4);
  playout.addShape(shape(1, 0, [0, 0, 0, 0]), 0);
  playout.addShape(shape(2, 20, [1], [2]), 20);
  for (let now = 20; now < 60; now += 5) playout.advance(now);
  playout.addShape(shape(3, 40, [1], [3]), 60);
  const moved = new Set<number>();
  for (let now = 62; now < 200; now += 5) {
    const step = playout.advance(now);
    assert.ok(!step.isAll);
    step.nodes.forEach((node) => moved.add(node));
  }
  assert.deepEqual([...moved].sort(), [3]);
  assert.deepEqual([2, 5, 8, 11].map((i) => playout.shown[i]), [0, 0, 1, 1]);
});

test("a_new_topology_shows_with_its_first_shape", () => {
  const playout = new Playout();
  assert.equal(playout.addSurface(1, 2), 1);
  playout.addShape(shape(1, 0, [0, 0]), 0);
  assert.equal(playout.addSurface(2, 3), null);
  playout.addShape(shape(2, 40, [1, 2, 3], null, 2), 40);
  assert.equal(playout.advance(40).version, null);
  assert.equal(playout.shown.length, 6);
  const versions = [60, 80, 100].map((now) => playout.advance(now).version).filter((v) => v !== null);
  assert.deepEqual(versions, [2]);
  assert.deepEqual([2, 5, 8].map((i) => playout.shown[i]), [1, 2, 3]);
});

test("shapes_that_do_not_fit_the_topology_are_ignored", () => {
  const playout = new Playout();
  playout.addSurface(1, 2);
  assert.ok(!playout.addShape(shape(1, 0, [0, 0, 0]), 0));
  assert.ok(!playout.addShape(shape(1, 0, [0, 0], null, 9), 0));
  playout.addShape(shape(1, 0, [0, 0]), 0);
  assert.ok(!playout.addShape(shape(2, 20, [1], [2]), 20));
});

test("tools_are_interpolated_at_the_displayed_time", () => {
  const playout = new Playout();
  playout.addSurface(1, 1);
  for (let i = 0; i < 60; i++) {
    playout.addTools(frame(i * PERIOD_MS, (i * PERIOD_MS) / 1000), i * PERIOD_MS);
    playout.advance(i * PERIOD_MS + 7);
    const [tool] = playout.tools();
    assert.ok(Math.abs(tool.position[0] - Math.max(0, playout.time_s!)) < 1e-9);
  }
});

test("a_pose_without_force_takes_that_of_its_contacts", () => {
  const [pose] = frame(0, 0).tools;
  const reactions = [{ participant: 1, force: [0, 0, 3] as [number, number, number], position: [0, 0, 0] as [number, number, number], points: [] }];
  assert.deepEqual(withReaction(pose, reactions).force, [0, 0, 3]);
  assert.deepEqual(withReaction({ ...pose, force: [1, 0, 0] }, reactions).force, [1, 0, 0]);
  assert.deepEqual(withReaction({ ...pose, participant: 2 }, reactions).force, [0, 0, 0]);
});
