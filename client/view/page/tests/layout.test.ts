import assert from "node:assert/strict";
import { test } from "node:test";
import { Layout } from "../src/layout.ts";
import type { Group, Surface } from "../src/messages.ts";

/** Two pyramids of four sides on a common square: region 0 below, region 1 above, whose face to region 0 is the square. */
function pyramids(): Surface {
  const rest = [0, 0, -1, 0, 0, 1, 1, 0, 0, 0, 1, 0, -1, 0, 0, 0, -1, 0];
  const below: number[] = [];
  const above: number[] = [];
  for (let i = 0; i < 4; i++) {
    const [a, b] = [2 + i, 2 + ((i + 1) % 4)];
    below.push(a, 0, b);
    above.push(a, b, 1);
  }
  const square = [2, 4, 3, 2, 5, 4];
  const triangles = Uint32Array.from([...below, ...above, ...square]);
  const group = (region: number, other: number | null, start: number, count: number): Group => ({ region, other, is_wound: false, start, count });
  return {
    kind: "surface", version: 1, hash: "", spacing_m: 1, groups: [group(0, null, 0, 4), group(1, null, 4, 4), group(1, 0, 8, 2)],
    numbers: Uint32Array.from([0, 1, 2, 3, 4, 5]), rest: Float32Array.from(rest), triangles,
  };
}

/** Volume enclosed by the parts of a region; only a closed surface gives that of the body. */
function volume(layout: Layout, region: number): number {
  let sum = 0;
  for (const part of layout.parts.filter((p) => p.region === region)) {
    for (let i = 0; i < part.index.length; i += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => layout.positions.subarray(3 * part.index[i + k], 3 * part.index[i + k] + 3));
      sum += a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
    }
  }
  return sum / 6;
}

test("each_region_has_a_closed_surface_with_mirrored_interfaces", () => {
  const layout = new Layout(pyramids());
  assert.ok(Math.abs(volume(layout, 0) - 2 / 3) < 1e-6);
  assert.ok(Math.abs(volume(layout, 1) - 2 / 3) < 1e-6);
});

test("normals_of_an_interface_point_out_of_its_region", () => {
  const layout = new Layout(pyramids());
  layout.vertexNode.forEach((_, vertex) => {
    const part = layout.parts[layout.vertexPart[vertex]];
    if (part.kind === "interface") assert.equal(layout.normals[3 * vertex + 2], part.region === 1 ? -1 : 1);
  });
});

test("a_moved_node_changes_the_same_as_a_new_layout_would", () => {
  const surface = pyramids();
  const layout = new Layout(surface);
  layout.takeChanges(0);
  const displacements = new Float32Array(surface.rest.length);
  displacements[3 * 1 + 2] = 0.5;
  layout.update(displacements, Uint32Array.from([1]));
  const whole = new Layout(surface);
  whole.update(displacements, null);
  assert.deepEqual(layout.positions, whole.positions);
  assert.deepEqual(layout.normals, whole.normals);
  const changed = layout.takeChanges(0).reduce((sum, [, count]) => sum + count, 0);
  assert.ok(changed > 0 && changed < layout.vertexNode.length, `${changed} of ${layout.vertexNode.length} vertices`);
  assert.deepEqual(layout.takeChanges(0), []);
});
