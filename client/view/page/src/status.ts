// State of the connection and of the own participant: one word in the header, banners for states of a running session, and a
// card for states in which nothing can be done but wait, read or reload.
import { at, make, setText } from "./element.ts";

export type Phase =
  | { kind: "asking" }
  | { kind: "connecting"; seconds_left: number | null; sentence: string | null }
  | { kind: "downloading" }
  | { kind: "joined" }
  | { kind: "lost"; seconds_left: number; sentence: string | null }
  | { kind: "refused"; sentence: string }
  | { kind: "ended"; sentence: string }
  | { kind: "unsupported"; sentence: string };

/** States of a running session that the participant must know. */
export interface Conditions {
  isCatchingUp: boolean;
  isDemoted: boolean;
  isMuted: boolean;
  isFrozen: boolean;
}

const NOTICES_SHOWN = 4;
const NOTICES_KEPT = 20;
const NOTICE_MS = 8000;

const BANNERS: [keyof Conditions, string, string][] = [
  ["isCatchingUp", "catching up", "Catching up with the session"],
  ["isDemoted", "demoted", "Your network is too slow: you watch until it recovers, and keep your seat"],
  ["isMuted", "muted", "The instructor has muted your tool"],
  ["isFrozen", "frozen", "The instructor has frozen the session"],
];

export class Status {
  phase: Phase = { kind: "connecting", seconds_left: null, sentence: null };
  private conditions: Conditions = { isCatchingUp: false, isDemoted: false, isMuted: false, isFrozen: false };
  readonly notices: string[] = [];

  constructor() {
    at("card-reload").addEventListener("click", () => location.reload());
    this.show();
  }

  /** The state in one or two words, as the page shows it. */
  get word(): string {
    switch (this.phase.kind) {
      case "joined":
        return BANNERS.find(([key]) => this.conditions[key])?.[1] ?? "joined";
      case "lost":
        return "link lost";
      default:
        return this.phase.kind;
    }
  }

  set(phase: Phase): void {
    const isFinal = ["refused", "ended", "unsupported"].includes(this.phase.kind);
    if (isFinal) return;
    this.phase = phase;
    this.show();
  }

  setConditions(conditions: Conditions): void {
    this.conditions = conditions;
    this.show();
  }

  notice(text: string): void {
    this.notices.push(text);
    if (this.notices.length > NOTICES_KEPT) this.notices.shift();
    const list = at("notices");
    const element = make("div", { text: capital(text) });
    list.append(element);
    while (list.children.length > NOTICES_SHOWN) list.firstElementChild!.remove();
    setTimeout(() => element.remove(), NOTICE_MS);
  }

  private show(): void {
    const tone = { joined: "good", refused: "bad", ended: "bad", unsupported: "bad", lost: "bad" }[this.phase.kind as string] ?? "warn";
    const word = this.word;
    at("status").dataset.tone = tone === "good" && word !== "joined" ? "warn" : tone;
    setText(at("status"), word === "asking" ? "Not joined" : capital(word));
    const banners = at("banners");
    const wanted = this.phase.kind === "joined" ? BANNERS.filter(([key]) => this.conditions[key]).map(([, , text]) => text) : [];
    if ([...banners.children].map((c) => c.textContent).join("\n") !== wanted.join("\n")) {
      banners.replaceChildren(...wanted.map((text) => make("div", { text })));
    }
    this.showCard();
  }

  private showCard(): void {
    const phase = this.phase;
    const [title, text] = card(phase);
    const isOver = phase.kind === "refused" || phase.kind === "ended";
    at("card").hidden = phase.kind === "joined";
    setText(at("card-title"), title);
    setText(at("card-text"), capital(text));
    at("card-progress").hidden = !["connecting", "downloading", "lost"].includes(phase.kind);
    at("name-form").hidden = phase.kind !== "asking";
    at("card-reload").hidden = !isOver;
  }
}

/** A sentence of the host with a capital at its beginning. */
function capital(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function card(phase: Phase): [string, string] {
  const left = (seconds: number): string => `Trying again, ${seconds} second${seconds === 1 ? "" : "s"} left.`;
  switch (phase.kind) {
    case "asking":
      return ["Join the session", "The other participants see this name beside your tool."];
    case "connecting":
      return ["Connecting", [phase.sentence, phase.seconds_left === null ? "Waiting for the host." : left(phase.seconds_left)].filter(Boolean).join(" ")];
    case "downloading":
      return ["Downloading the surface", "The picture appears when the surface of the model has arrived."];
    case "lost":
      return ["Link lost", [phase.sentence, left(phase.seconds_left), "Your seat is kept meanwhile."].filter(Boolean).join(" ")];
    case "refused":
      return ["The host refused this page", phase.sentence];
    case "ended":
      return ["The session is over", phase.sentence];
    case "unsupported":
      return ["This browser cannot show the tissue", phase.sentence];
    case "joined":
      return ["", ""];
  }
}
