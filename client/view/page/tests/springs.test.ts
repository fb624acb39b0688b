import assert from "node:assert/strict";
import { test } from "node:test";
import type { LineSegments } from "three";
import type { Springs, Surface } from "../src/messages.ts";
import { SpringView } from "../src/springs.ts";
import type { Tissue } from "../src/tissue.ts";

/** Four nodes in a row, 1 mm apart. */
const rest = Float32Array.from([0, 1, 2, 3].flatMap((i) => [i / 1000, 0, 0]));

function view(): { springs: SpringView; nodes: Float32Array } {
  const surface = { kind: "surface", version: 7, rest } as Surface;
  const nodes = rest.slice();
  const springs = new SpringView({ surface, nodes } as unknown as Tissue);
  springs.region = 2;
  return { springs, nodes };
}

function message(ends = [0, 1, 1, 2, 2, 3], version = 7, region = 2): Springs {
  return { kind: "springs", version, region, isCutShort: false, ends: Uint32Array.from(ends) };
}

test("strains_follow_the_nodes_that_moved", () => {
  const { springs, nodes } = view();
  springs.add(message());
  const [lines] = springs.group.children as LineSegments[];
  const positions = lines.geometry.getAttribute("position").array;
  nodes[6] += 2e-4;
  springs.update(Uint32Array.from([2]));
  const { count, least, greatest } = springs.figures()!;
  assert.equal(count, 3);
  assert.ok(Math.abs(least + 0.2) < 1e-4 && Math.abs(greatest - 0.2) < 1e-4, `${least} ${greatest}`);
  assert.deepEqual([...positions], [0, 1, 1, 2, 2, 3].flatMap((node) => [...nodes.slice(3 * node, 3 * node + 3)]));
});

test("springs_of_another_region_or_topology_or_beyond_the_surface_are_not_displayed", () => {
  for (const other of [message(undefined, 8), message(undefined, 7, 1), message([0, 4])]) {
    const { springs } = view();
    springs.add(other);
    assert.equal(springs.figures(), null);
  }
});

test("springs_that_came_earlier_are_displayed_again", () => {
  const { springs } = view();
  springs.add(message());
  springs.region = null;
  springs.display();
  assert.equal(springs.figures(), null);
  springs.region = 2;
  springs.display();
  assert.equal(springs.figures()?.count, 3);
  springs.forget();
  springs.display();
  assert.equal(springs.figures(), null);
});
