import assert from "node:assert/strict";
import { test } from "node:test";
import { RADIUS_MAX_MM, RADIUS_MIN_MM, parts, resized, usual } from "../src/form.ts";
import { TOOL_KINDS, type Tool } from "../src/messages.ts";

const near = (a: number, b: number): void => assert.ok(Math.abs(a - b) < 1e-12, `${a} is not ${b}`);

test("jaws_meet_when_closed_and_open_by_a_quarter_of_their_length", () => {
  const forceps: Tool = { kind: "forceps", radius_mm: 2, length_mm: 40, width_mm: 6 };
  for (const [isHeld, apart] of [[false, 4e-3 + 0.01], [true, 4e-3]] as const) {
    const [one, two] = parts(forceps, isHeld);
    near(one.middle[0] - one.along[0] - (two.middle[0] - two.along[0]), apart);
    near(one.middle[0] + one.along[0] - (two.middle[0] + two.along[0]), 4e-3);
    near(one.middle[2] - one.along[2], 0);
  }
});

test("lines_begin_at_the_tip_and_plates_lie_around_it", () => {
  for (const kind of ["blade", "needle"] as const) {
    const [line] = parts({ kind, radius_mm: 1, length_mm: 30, width_mm: 0 }, true);
    near(line.middle[2] - line.along[2], 0);
    near(line.middle[2] + line.along[2], 0.03);
  }
  const [plate] = parts({ kind: "plate", radius_mm: 1, length_mm: 30, width_mm: 20 }, false);
  assert.deepEqual(plate, { middle: [0, 0, 0], along: [0.015, 0, 0], across: [0, 0.01, 0] });
});

test("usual_tools_have_the_dimensions_of_their_kind", () => {
  for (const kind of TOOL_KINDS) {
    const tool = usual(kind);
    assert.equal(tool.length_mm > 0, kind !== "ball");
    assert.equal(tool.width_mm > 0, kind === "plate" || kind === "forceps");
  }
});

test("the_radius_changes_by_steps_within_its_bounds", () => {
  let tool = usual("ball");
  for (let i = 0; i < 40; i++) {
    const next = resized(tool, 1);
    assert.ok(next.radius_mm > tool.radius_mm || next.radius_mm === RADIUS_MAX_MM);
    tool = next;
  }
  assert.equal(tool.radius_mm, RADIUS_MAX_MM);
  for (let i = 0; i < 60; i++) {
    const next = resized(tool, -1);
    assert.ok(next.radius_mm < tool.radius_mm || next.radius_mm === RADIUS_MIN_MM);
    tool = next;
  }
  assert.equal(tool.radius_mm, RADIUS_MIN_MM);
});
