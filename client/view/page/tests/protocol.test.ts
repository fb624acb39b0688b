import assert from "node:assert/strict";
import { test } from "node:test";
import { ProtocolError, type State, type Welcome } from "../src/messages.ts";
import { decodeText } from "../src/protocol.ts";

const welcome = {
  type: "welcome",
  participant: 3,
  name: "A",
  role: "trainee",
  source: "server",
  can_steer: true,
  tick_hz: 30,
  regions: [{ name: "skin", material: "skin", is_pinned: false }],
  seat: { participant: 3, token: "t" },
};
const state = {
  type: "state",
  session: {
    clock_s: 1, is_frozen: false, is_locked: false, seats: 4, spectators: null, delay_ms: null, delay_mode: "fixed", delay_cap_ms: 400,
    topology_version: 2, topology_hash: "00", operations: 1, cuts: 1, can_undo: true, can_redo: false, cpu: { tissue: 0.5, room: null },
  },
  participants: [
    {
      id: 3, name: "A", role: "trainee", tool: { kind: "blade", radius_mm: 1, length_mm: 20, width_mm: 0 }, is_connected: true,
      is_demoted: false, is_muted: false, force_limit_n: null, rtt_ms: null, loss: 0, wanted_ms: null, is_page: true, emulation: { delay_ms: 150, loss_percent: 5.5 },
    },
  ],
  own: null,
  annotations: [{ id: 1, text: "<b>", kind: "pin", nodes: [1, 2, 3], weights: [0.5, 0.25, 0.25], offset_m: [0, 0, 0.01] }],
  camera: null,
  invitations: [{ id: 2, role: "trainee", name: null, expires_us: 6e7, is_single_use: true }],
};

test("welcome_and_state_are_read_and_unknown_keys_are_tolerated", () => {
  const read = decodeText(JSON.stringify({ ...welcome, later: 1 })) as Welcome;
  assert.deepEqual(read, welcome);
  const { session, participants, annotations, invitations } = decodeText(JSON.stringify(state)) as State;
  assert.deepEqual(session.cpu, { tissue: 0.5 });
  assert.equal(session.delay_ms, null);
  assert.equal(participants[0].tool?.kind, "blade");
  assert.deepEqual(participants[0].emulation, { delay_ms: 150, loss_percent: 5.5 });
  assert.equal(annotations[0].text, "<b>");
  assert.deepEqual(invitations, state.invitations);
});

test("unknown_types_are_ignored", () => {
  assert.equal(decodeText('{"type":"later"}'), null);
});

test("wrong_values_are_rejected_with_their_key", () => {
  const wrong: [object, RegExp][] = [
    [{ ...welcome, participant: -1 }, /participant/],
    [{ ...welcome, regions: {} }, /regions/],
    [{ ...state, annotations: [{ ...state.annotations[0], nodes: [1, 2] }] }, /nodes/],
    [{ ...state, participants: [{ ...state.participants[0], tool: { kind: "saw" } }] }, /saw/],
    [{ ...state, participants: [{ ...state.participants[0], emulation: { delay_ms: "x" } }] }, /delay_ms/],
    [{ ...state, invitations: [{ ...state.invitations[0], name: 7 }] }, /name/],
    [{ type: "invitation", id: 2, url: null }, /link/],
    [{ type: "refused" }, /sentence/],
  ];
  for (const [message, key] of wrong) {
    assert.throws(() => decodeText(JSON.stringify(message)), (error) => error instanceof ProtocolError && key.test(error.message));
  }
  assert.throws(() => decodeText("{"), ProtocolError);
});
