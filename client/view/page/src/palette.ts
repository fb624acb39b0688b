// The palette of tools: kind, radius, and the button that cuts or grasps.
import { at, button, icon, make, setText } from "./element.ts";
import { resized, usual } from "./form.ts";
import { TOOL_KINDS, type Tool, type ToolKind } from "./messages.ts";

const ICONS: Record<ToolKind, string> = {
  ball: "M12 3v9M12 12a4 4 0 1 0 .01 0",
  blade: "M12 2v7M12 9h4v6q0 4-4 7z",
  needle: "M12 2v4M10 6h4M12 6v16",
  plate: "M12 3v11M4 14h16v4H4z",
  forceps: "M12 2l-4 10 3 9M12 2l4 10-3 9",
};
/** Time in which a choice has come back from the host, ms. */
const SETTLES_MS = 2000;
const HOLD: Record<ToolKind, string> = { ball: "", blade: "Cut", needle: "", plate: "", forceps: "Grasp" };

const TOOL_HINT = "Wheel forwards: deeper. Right mouse button: turns the view.";
const VIEW_HINT = "The wheel zooms. Choose Tool to press and cut.";

export class Palette {
  tool: Tool = usual("ball");
  private readonly kinds = new Map<ToolKind, HTMLButtonElement>();
  private readonly radius = make("output", { class: "grow" });
  private readonly hold: HTMLButtonElement;
  private readonly moves: HTMLButtonElement;
  private readonly turns: HTMLButtonElement;
  private readonly hint = make("p", { class: "hint" });
  private isHeld = false;
  private chosen_ms = Number.NEGATIVE_INFINITY;

  constructor(
    private readonly onTool: (tool: Tool) => void,
    private readonly onHold: (isHeld: boolean) => void,
    onMode: (movesTool: boolean) => void,
    onDepth: (steps: number) => void,
  ) {
    const kinds = make("div", { class: "kinds", role: "group", "aria-label": "Kind of tool" });
    TOOL_KINDS.forEach((kind, i) => {
      const name = kind.charAt(0).toUpperCase() + kind.slice(1);
      const chosen = make("button", { type: "button", title: `${name} (key ${i + 1})`, onclick: (event: MouseEvent) => this.take(kind, event) });
      chosen.append(icon(ICONS[kind]), name);
      this.kinds.set(kind, chosen);
      kinds.append(chosen);
    });
    this.hold = button("Cut", "Hold the tool's button (also the space bar)", () => this.setHeld(!this.isHeld));
    this.moves = named("Drag moves Tool", button("Tool", "A drag moves the tool (key V)", () => onMode(true)));
    this.turns = named("Drag moves View", button("View", "A drag turns the view (key V)", () => onMode(false)));
    at("palette").append(
      make("h2", { text: "Tool" }),
      kinds,
      make(
        "div",
        { class: "row" },
        this.radius,
        named("Smaller radius", button("−", "Smaller radius (key [)", () => this.resize(-1))),
        named("Larger radius", button("+", "Larger radius (key ])", () => this.resize(1))),
      ),
      make(
        "div",
        { class: "row" },
        make("span", { class: "grow", text: "Depth" }),
        button("Nearer", "Towards you (Page Up)", () => onDepth(-1)),
        button("Deeper", "Away from you (Page Down)", () => onDepth(1)),
      ),
      make("div", { class: "row" }, make("span", { class: "grow", text: "Drag moves" }), this.moves, this.turns),
      make("div", { class: "row" }, this.hold),
      this.hint,
    );
    this.show();
  }

  /** Chooses by a button. After a click the picture gets the focus, so that the space bar holds the new tool's button. */
  private take(kind: ToolKind, event: MouseEvent): void {
    this.choose(kind);
    if (event.detail > 0) at("picture").focus({ preventScroll: true });
  }

  choose(kind: ToolKind): void {
    if (kind === this.tool.kind) return;
    this.set(usual(kind));
  }

  resize(direction: 1 | -1): void {
    this.set(resized(this.tool, direction));
  }

  private set(tool: Tool): void {
    this.setHeld(false);
    this.tool = tool;
    this.chosen_ms = performance.now();
    this.show();
    this.onTool(tool);
  }

  private setHeld(isHeld: boolean): void {
    if (this.isHeld === isHeld) return;
    this.isHeld = isHeld;
    this.onHold(isHeld);
  }

  /** Shows the tool that the host has for this participant, unless a choice is still on its way to the host and back. */
  adopt(tool: Tool): void {
    if (performance.now() - this.chosen_ms < SETTLES_MS || JSON.stringify(tool) === JSON.stringify(this.tool)) return;
    this.tool = tool;
    this.show();
  }

  /** Shows whether the tool's button is held, and what a drag moves. */
  showMode(isHeld: boolean, movesTool: boolean): void {
    this.hold.setAttribute("aria-pressed", String(isHeld));
    this.moves.setAttribute("aria-pressed", String(movesTool));
    this.turns.setAttribute("aria-pressed", String(!movesTool));
    setText(this.hint, movesTool ? TOOL_HINT : VIEW_HINT);
  }

  private show(): void {
    for (const [kind, element] of this.kinds) element.setAttribute("aria-pressed", String(kind === this.tool.kind));
    setText(this.radius, `Radius ${this.tool.radius_mm} mm`);
    this.hold.hidden = HOLD[this.tool.kind] === "";
    setText(this.hold, `${HOLD[this.tool.kind]} (space)`);
  }
}

/** Gives a button a name for screen readers. */
function named(name: string, element: HTMLButtonElement): HTMLButtonElement {
  element.setAttribute("aria-label", name);
  return element;
}
