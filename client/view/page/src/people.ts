// The participants with role and figures; an instructor also gets the acts on each.
import { at, button, figure, make, setText } from "./element.ts";
import type { Act, Participant } from "./messages.ts";
import { ask } from "./question.ts";
import { ownerColour } from "./tools.ts";

/** The largest emulation that the host accepts. */
const DELAY_MAX_MS = 500;
const LOSS_MAX_PERCENT = 30;

interface Row {
  root: HTMLElement;
  select: HTMLButtonElement;
  who: HTMLElement;
  role: HTMLElement;
  quality: HTMLElement;
  marks: HTMLElement;
  mute: HTMLButtonElement;
  acts: HTMLElement;
  person: Participant;
}

/** Quality of a connection in one word, by loss and round trip. */
function quality(person: Participant): [string, string] {
  if (!person.is_connected) return ["away", "bad"];
  if (person.is_demoted) return ["too slow", "bad"];
  const { loss, rtt_ms } = person;
  if (loss === null && rtt_ms === null) return ["", "good"];
  if ((loss ?? 0) > 0.05 || (rtt_ms ?? 0) > 250) return ["poor", "bad"];
  if ((loss ?? 0) > 0.01 || (rtt_ms ?? 0) > 100) return ["fair", "warn"];
  return ["good", "good"];
}

export class People {
  private readonly rows = new Map<number, Row>();
  private readonly title = make("h2", { text: "Participants" });
  private readonly list = make("div");
  /** The participant whose figures are plotted. */
  selected: number | null = null;
  private chosen: number | null = null;
  isInstructor = false;

  constructor(
    private readonly send: (act: Act) => void,
    private readonly onSelect: () => void,
  ) {
    at("people").append(this.title, this.list);
  }

  show(people: readonly Participant[], own: number | null): void {
    // The chosen participant, or else the own one, who may join after the first state.
    const present = [this.chosen, own].find((id) => people.some((p) => p.id === id));
    this.selected = present ?? people[0]?.id ?? null;
    setText(this.title, `Participants (${people.length})`);
    for (const [id, row] of this.rows) {
      if (people.some((p) => p.id === id)) continue;
      row.root.remove();
      this.rows.delete(id);
    }
    for (const person of people) {
      let row = this.rows.get(person.id);
      if (row === undefined) {
        row = this.row(person);
        this.rows.set(person.id, row);
        this.list.append(row.root);
      }
      this.fill(row, person, own);
    }
  }

  private fill(row: Row, person: Participant, own: number | null): void {
    row.person = person;
    row.select.setAttribute("aria-pressed", String(person.id === this.selected));
    setText(row.who, person.id === own ? `${person.name} (you)` : person.name);
    setText(row.role, person.is_page ? `${person.role}, browser` : person.role);
    const [word, tone] = quality(person);
    setText(row.quality, word);
    row.quality.dataset.tone = tone;
    const marks = [
      figure(person.rtt_ms, 0, "ms"),
      person.loss === null ? null : `${(100 * person.loss).toFixed(1)}\u202f% loss`,
      person.tool === null ? null : `${person.tool.kind} ${person.tool.radius_mm}\u202fmm`,
      person.is_muted ? "muted" : null,
      person.emulation === null ? null : `emulated ${person.emulation.delay_ms}\u202fms, ${person.emulation.loss_percent}\u202f%`,
      person.force_limit_n === null ? null : `at most ${person.force_limit_n}\u202fN`,
    ];
    setText(row.marks, marks.filter((m) => m !== null && m !== "–").join(" · "));
    setText(row.mute, person.is_muted ? "Unmute" : "Mute");
    row.acts.hidden = !this.isInstructor;
  }

  private row(person: Participant): Row {
    const who = make("span", { class: "who" });
    const role = make("span", { class: "role" });
    const word = make("span", { class: "quality" });
    const marks = make("span", { class: "marks" });
    const dot = make("span", { class: "dot" });
    dot.style.setProperty("--owner", ownerColour(person.id));
    const select = make("button", { type: "button", title: "Plot this participant" });
    select.append(dot, who, word, make("span"), role, make("span"), marks);
    const limit = make("input", { type: "number", min: 0.1, max: 50, step: 0.1, id: `limit-${person.id}`, placeholder: "none" });
    const delay = make("input", { type: "number", min: 0, max: DELAY_MAX_MS, step: 10, id: `emulated-delay-${person.id}`, placeholder: "0" });
    const loss = make("input", { type: "number", min: 0, max: LOSS_MAX_PERCENT, step: 0.5, id: `emulated-loss-${person.id}`, placeholder: "0" });
    const mute = button("Mute", "The tool stops touching the tissue", () => {
      this.send({ act: "mute", participant: person.id, is_muted: !row.person.is_muted });
    });
    const away = async (act: "kick" | "ban", question: string, confirm: string): Promise<void> => {
      if (await ask(question.replace("NAME", row.person.name), confirm)) this.send({ act, participant: person.id });
    };
    const acts = make(
      "details",
      {},
      make("summary", { text: `Act on ${person.name}` }),
      make(
        "div",
        { class: "row" },
        mute,
        button("Hand over", "Only this participant has a tool", () => this.send({ act: "hand_over", participant: person.id })),
        button("Kick", "Ends this participant's connection", () => void away("kick", "Remove NAME from the session?", "Remove")),
        button("Ban", "Also refuses to let this participant in again", () => void away("ban", "Remove NAME and refuse to let them in again?", "Ban")),
      ),
      make(
        "div",
        { class: "row" },
        make("label", { for: `limit-${person.id}`, text: "Force limit, N" }),
        limit,
        button("Set", "An empty field removes the limit", () => {
          const newtons = limit.value === "" ? null : Number(limit.value);
          if (newtons === null || newtons > 0) this.send({ act: "force_limit", participant: person.id, newtons });
        }),
      ),
    );
    const emulation = make(
      "div",
      { class: "row" },
      make("label", { for: delay.id, text: "Emulated delay, ms one way" }),
      delay,
      make("label", { for: loss.id, text: "loss, %" }),
      loss,
      button("Emulate", "Delays and drops what this participant sends and receives; 0 and 0 end it", () => {
        const [delay_ms, loss_percent] = [Number(delay.value), Number(loss.value)];
        if (delay_ms >= 0 && loss_percent >= 0) this.send({ act: "emulate", participant: person.id, delay_ms, loss_percent });
      }),
    );
    acts.append(emulation);
    const root = make("div", { class: "person" }, select, acts);
    const row: Row = { root, select, who, role, quality: word, marks, mute, acts, person };
    select.addEventListener("click", () => {
      this.selected = this.chosen = person.id;
      for (const [id, other] of this.rows) other.select.setAttribute("aria-pressed", String(id === person.id));
      this.onSelect();
    });
    return row;
  }
}
