// Figures of the session, of the own loop and of this page.
import { at, figure, make, setText } from "./element.ts";
import type { Cores, State } from "./messages.ts";

/** Figures of the page itself. */
export interface PageFigures {
  fps: number;
  rtt_ms: number | null;
  transport: string | null;
  latency_ms: number | null;
  delay_ms: number | null;
  force_n: number | null;
}

/** A time span as hours, minutes and seconds. */
export function clock(seconds: number | null): string {
  if (seconds === null) return "";
  const s = Math.max(0, Math.floor(seconds));
  const two = (x: number): string => String(x).padStart(2, "0");
  return `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)}:${two(s % 60)}`;
}

export class Figures {
  private readonly list = make("dl");
  private readonly values = new Map<string, HTMLElement>();

  constructor() {
    at("figures").append(make("h2", { text: "Figures" }), this.list);
  }

  show(state: State, own: number | null, page: PageFigures): void {
    const self = state.participants.find((p) => p.id === own);
    const { session } = state;
    const percent = (share: number | null | undefined): number | null => (share === null || share === undefined ? null : 100 * share);
    const rows: [string, string, string][] = [
      ["Round trip", figure(state.own?.rtt_ms ?? self?.rtt_ms ?? page.rtt_ms, 1, "ms"), "between this participant and the server"],
      ["Loss", figure(percent(state.own?.loss ?? self?.loss), 2, "%"), "lost packets of this participant"],
      ["Playout delay D", figure(page.delay_ms ?? session.delay_ms, 0, "ms"), `mode ${session.delay_mode ?? "unknown"}`],
      ["Delay wanted", figure(self?.wanted_ms, 0, "ms"), "delay that this participant's network requires"],
      ["Own force", figure(state.own?.force_n ?? page.force_n, 2, "N"), "force on the own tool"],
    ];
    if (state.own !== null) {
      rows.push(
        ["Device", state.own.device ?? "–", "haptic device"],
        ["Loop rate", figure(state.own.loop_hz, 0, "Hz"), "rate of the force loop"],
        ["Lateness p99", figure(state.own.late_us_p99, 0, "µs"), "99th percentile of the lateness of the force loop"],
        ["Contact model age", figure(state.own.model_age_ms, 1, "ms"), "age of the contact model that renders forces"],
      );
    }
    rows.push(
      ["Transport", page.transport ?? "–", "connection between this page and its host"],
      ["Picture rate", figure(page.fps, 0, "fps"), "pictures per second of this page"],
      ["Solve to picture", figure(page.latency_ms, 0, "ms"), "median of the last 2 s"],
      ["Topology", `${session.topology_version} · ${session.topology_hash.slice(0, 8)}`, `version and hash ${session.topology_hash}`],
      ["Operations", session.operations === null ? "–" : String(session.operations), "entries of the operation log"],
      ["Cuts", session.cuts === null ? "–" : String(session.cuts), "cuts in effect"],
    );
    this.addCores(rows, "server", session.cpu);
    if (state.own !== null) this.addCores(rows, "client", state.own.cpu);
    for (const [name, value, title] of rows) this.put(name, value, title);
  }

  private addCores(rows: [string, string, string][], program: string, cpu: Cores): void {
    for (const [role, cores] of Object.entries(cpu)) {
      rows.push([`CPU ${role} (${program})`, figure(cores, 2, "cores"), `cores used by ${role} threads of the ${program}`]);
    }
  }

  private put(name: string, value: string, title: string): void {
    let element = this.values.get(name);
    if (element === undefined) {
      element = make("dd");
      this.values.set(name, element);
      this.list.append(make("dt", { text: name, title }), element);
    }
    element.title = title;
    setText(element, value);
  }
}
