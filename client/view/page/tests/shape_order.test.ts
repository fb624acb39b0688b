import assert from "node:assert/strict";
import { test } from "node:test";
import type { Shape } from "../src/messages.ts";
import { ShapeOrder } from "../src/shape_order.ts";

const shape = (number: number, isFull = false, version = 0): Shape => ({
  kind: "shape",
  version,
  number,
  time_us: number,
  solved_ms: 0,
  nodes: isFull ? null : new Uint32Array(0),
  displacements: new Float32Array(0),
  reactions: [],
});

function started(): { order: ShapeOrder; numbers: number[] } {
  const numbers: number[] = [];
  const order = new ShapeOrder((s) => numbers.push(s.number));
  order.addSurface(0);
  return { order, numbers };
}

test("shapes_that_overtook_one_another_are_delivered_in_order", () => {
  const { order, numbers } = started();
  for (const [number, isFull] of [[4, false], [3, true], [6, false], [5, false]] as const) order.add(shape(number, isFull));
  assert.deepEqual(numbers, [3, 4, 5, 6]);
});

test("a_change_waits_for_the_one_before_it_until_a_full_shape_comes", () => {
  const { order, numbers } = started();
  order.add(shape(1, true));
  order.add(shape(3));
  order.add(shape(4));
  assert.deepEqual(numbers, [1]);
  order.add(shape(6, true));
  order.add(shape(2));
  order.add(shape(7));
  assert.deepEqual(numbers, [1, 6, 7]);
});

test("a_shape_waits_for_the_surface_of_its_topology", () => {
  const { order, numbers } = started();
  order.add(shape(1, true));
  order.add(shape(3, true, 1));
  order.add(shape(4, false, 1));
  order.add(shape(2));
  assert.deepEqual(numbers, [1, 2]);
  order.addSurface(1);
  assert.deepEqual(numbers, [1, 2, 3, 4]);
});

test("few_shapes_wait_however_many_come", () => {
  const { order, numbers } = started();
  order.add(shape(0, true));
  for (let number = 2; number < 1000; number++) order.add(shape(number));
  order.add(shape(1));
  assert.deepEqual(numbers, [0, 1]);
  order.add(shape(1000, true));
  assert.equal(numbers.at(-1), 1000);
});
