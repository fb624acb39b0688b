// The instructor's console: acts on the whole session. The server checks every act again.
import { at, button, make, setText } from "./element.ts";
import { Invitations } from "./invitations.ts";
import type { Act, Session, State } from "./messages.ts";
import { ask } from "./question.ts";

const TEXT_MAX = 200;
const MODES = ["adaptive", "fixed", "none"] as const;

/** An annotation that waits for a click on the tissue. */
export interface Placing {
  kind: "pin" | "arrow";
  text: string;
}

export class Console {
  private session: Session | null = null;
  private readonly freeze: HTMLButtonElement;
  private readonly undo: HTMLButtonElement;
  private readonly redo: HTMLButtonElement;
  private readonly lock: HTMLButtonElement;
  private readonly seats = make("input", { type: "number", id: "seats", min: 0, max: 64 });
  private readonly spectators = make("input", { type: "number", id: "spectators", min: 0, max: 64 });
  private readonly mode = make("select", { id: "mode" });
  private readonly delay = make("input", { type: "number", id: "delay", min: 0, max: 1000, step: 5 });
  private readonly text = make("input", { id: "note", class: "grow", maxlength: TEXT_MAX, placeholder: "Text" });
  private readonly kind = make("select", { id: "note-kind" });
  private readonly place: HTMLButtonElement;
  private readonly marks = make("div");
  readonly invitations: Invitations;
  placing: Placing | null = null;

  constructor(
    private readonly send: (act: Act) => void,
    showCamera: () => void,
    private readonly onPlacing: () => void,
    serverTime_us: () => number | null,
  ) {
    this.invitations = new Invitations(send, serverTime_us);
    this.freeze = button("Freeze all", "Stops all tools and the tissue", () => send({ act: "freeze", is_frozen: this.session?.is_frozen !== true }));
    this.freeze.className = "main";
    this.undo = button("Undo cut", "Takes the last cut back", () => this.session?.can_undo && send({ act: "undo" }));
    this.redo = button("Redo cut", "Makes the cut again", () => this.session?.can_redo && send({ act: "redo" }));
    this.lock = button("Lock", "Refuses newcomers", () => send({ act: "lock", is_locked: this.session?.is_locked !== true }));
    this.place = button("Place on the tissue", "Click a point of the tissue next; Escape cancels", () => this.begin());
    for (const mode of MODES) this.mode.append(make("option", { value: mode, text: mode }));
    this.mode.addEventListener("change", () => {
      this.delay.disabled = this.mode.value !== "adaptive";
    });
    for (const kind of ["pin", "arrow"]) this.kind.append(make("option", { value: kind, text: kind }));
    const reset = button("Reset", "Takes back all cuts", () => void this.reset());
    reset.classList.add("danger");
    at("console").append(
      make("h2", { text: "Instructor" }),
      make("div", { class: "row" }, this.freeze, this.undo, this.redo, reset),
      make("div", { class: "row" }, this.lock, button("Show my view to all", "Moves every camera to mine", showCamera)),
    );
    // Below the participants, whose tools an instructor mutes in haste.
    at("settings").append(
      make("h2", { text: "Settings" }),
      make("h3", { text: "Seats" }),
      make(
        "div",
        { class: "row" },
        make("label", { for: "seats", text: "In all" }),
        this.seats,
        make("label", { for: "spectators", text: "of these watching" }),
        this.spectators,
        button("Set", "Sets the number of seats", () => this.capacity()),
      ),
      this.invitations.root,
      make("h3", { text: "Playout delay D" }),
      make(
        "div",
        { class: "row" },
        make("label", { for: "mode", text: "Mode" }),
        this.mode,
        make("label", { for: "delay", text: "ms" }),
        this.delay,
        button("Set", "Sets the mode, and the cap of an adaptive delay; a fixed delay stays as it is", () => this.compensate()),
      ),
      make("h3", { text: "Annotations" }),
      make("div", { class: "row" }, make("label", { for: "note-kind", text: "Kind" }), this.kind, this.text),
      make("div", { class: "row" }, this.place),
      this.marks,
    );
    this.text.setAttribute("aria-label", "Text of the annotation");
  }

  private async reset(): Promise<void> {
    if (await ask("Take back all cuts, for all participants?", "Reset")) this.send({ act: "reset" });
  }

  private capacity(): void {
    const [seats, spectators] = [this.seats.valueAsNumber, this.spectators.valueAsNumber];
    if (seats >= 0 && spectators >= 0) this.send({ act: "capacity", seats: Math.round(seats), spectators: Math.round(spectators) });
  }

  private compensate(): void {
    const ms = this.delay.valueAsNumber;
    const mode = this.mode.value as (typeof MODES)[number];
    if (mode !== "adaptive") this.send({ act: "compensation", mode, ms: 0 });
    else if (ms >= 0) this.send({ act: "compensation", mode, ms });
  }

  private begin(): void {
    this.setPlacing(this.placing === null ? { kind: this.kind.value as "pin" | "arrow", text: this.text.value.trim() } : null);
  }

  /** Starts or ends the placing of an annotation. */
  setPlacing(placing: Placing | null): void {
    this.placing = placing;
    this.place.setAttribute("aria-pressed", String(placing !== null));
    setText(this.place, placing === null ? "Place on the tissue" : "Click the tissue (Escape cancels)");
    this.onPlacing();
  }

  show({ session, annotations, invitations }: State): void {
    this.invitations.show(invitations);
    const fill = (input: HTMLInputElement, before: number | null | undefined, now: number | null): void => {
      // A number that is being typed stays.
      if (now !== null && before !== now && document.activeElement !== input) input.value = String(now);
    };
    const before = this.session;
    fill(this.seats, before?.seats, session.seats);
    fill(this.spectators, before?.spectators, session.spectators);
    const delay = session.delay_cap_ms;
    if (before?.delay_mode !== session.delay_mode && session.delay_mode !== null) {
      this.mode.value = session.delay_mode;
      this.delay.disabled = session.delay_mode !== "adaptive";
    }
    if (before?.delay_mode !== session.delay_mode || before?.delay_cap_ms !== session.delay_cap_ms) fill(this.delay, null, delay);
    this.session = session;
    setText(this.freeze, session.is_frozen ? "Continue" : "Freeze all");
    setText(this.lock, session.is_locked ? "Unlock" : "Lock");
    this.lock.setAttribute("aria-pressed", String(session.is_locked));
    // A disabled button would lose the focus of the keyboard after the last undo.
    this.undo.setAttribute("aria-disabled", String(!session.can_undo));
    this.redo.setAttribute("aria-disabled", String(!session.can_redo));
    const key = JSON.stringify(annotations.map((a) => [a.id, a.kind, a.text]));
    if (this.marks.dataset.key === key) return;
    this.marks.dataset.key = key;
    this.marks.replaceChildren(
      ...annotations.map((a) =>
        make(
          "div",
          { class: "row" },
          make("span", { class: "grow", text: a.text || `(${a.kind} without text)` }),
          button("Remove", `Removes the ${a.kind}`, () => this.send({ act: "remove_annotation", id: a.id })),
        ),
      ),
    );
  }
}
