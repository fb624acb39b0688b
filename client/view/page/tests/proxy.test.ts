import assert from "node:assert/strict";
import { test } from "node:test";
import * as THREE from "three";
import { usual } from "../src/form.ts";
import { lead, leader, outline } from "../src/proxy.ts";

/** The ends of the segments, as points. */
function points(lines: THREE.Mesh): THREE.Vector3[] {
  const [start, end] = ["instanceStart", "instanceEnd"].map((name) => lines.geometry.getAttribute(name));
  return [start, end].flatMap((ends) => Array.from({ length: ends.count }, (_, i) => new THREE.Vector3().fromBufferAttribute(ends, i)));
}

test("outline_of_a_ball_lies_on_its_surface", () => {
  const ball = usual("ball");
  const all = points(outline(ball, false));
  assert.ok(all.length > 50);
  for (const point of all) assert.ok(Math.abs(1000 * point.length() - ball.radius_mm) < 1e-4);
});

test("outline_of_a_plate_is_a_box_with_its_thickness", () => {
  const plate = usual("plate");
  const box = new THREE.Box3().setFromPoints(points(outline(plate, false)));
  const size_mm = box.getSize(new THREE.Vector3()).multiplyScalar(1000).toArray();
  const wanted = [plate.length_mm, plate.width_mm, 0].map((extent) => extent + 2 * plate.radius_mm);
  size_mm.forEach((size, i) => assert.ok(Math.abs(size - wanted[i]) < 1e-4, `${size_mm} instead of ${wanted}`));
});

test("leader_joins_device_and_proxy_and_vanishes_without_a_distance", () => {
  const line = leader();
  const [from, to] = [new THREE.Vector3(1, 2, 3), new THREE.Vector3(1, 2.5, 2)];
  lead(line, from, to);
  line.updateMatrix();
  assert.ok(new THREE.Vector3(0, 0, 0).applyMatrix4(line.matrix).distanceTo(from) < 1e-9);
  assert.ok(new THREE.Vector3(0, 0, 1).applyMatrix4(line.matrix).distanceTo(to) < 1e-9);
  lead(line, from, from);
  assert.equal(line.visible, false);
});
