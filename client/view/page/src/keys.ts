// Keys of the whole page, the buttons of the camera, drawers and the help.
import type { OrbitCamera, StandardView } from "./camera.ts";
import { at, button, make } from "./element.ts";
import { TOOL_KINDS } from "./messages.ts";
import type { Palette } from "./palette.ts";

const VIEWS: StandardView[] = ["front", "back", "left", "right", "top", "bottom"];

const HELP: [string, string][] = [
  ["Drag", "moves the tool, or turns the view if you have none"],
  ["Wheel", "depth of the tool, or zoom; Ctrl + wheel always zooms"],
  ["Right button, Shift + drag", "turns the view; middle button shifts it"],
  ["Two fingers", "turn or shift the view and zoom"],
  ["Arrow keys, Page Up, Page Down", "move the tool, or turn the view and zoom"],
  ["Shift + arrow keys", "turn the view; Alt + arrow keys shift it"],
  ["Space", "holds the tool's button: blade cuts, forceps grasp"],
  ["1 to 5", "ball, blade, needle, plate, forceps"],
  ["[ and ]", "smaller and larger radius"],
  ["V", "a drag moves the tool or turns the view"],
  ["F", "shows the whole model"],
  ["Shift + 1 to 6", "front, back, left, right, top, bottom"],
  ["+ and −", "zoom, while the picture has the focus"],
  ["Escape", "cancels placing an annotation"],
];

export interface Orders {
  orbit: OrbitCamera;
  palette: Palette;
  canUseTools: () => boolean;
  switchMode: () => void;
  cancel: () => void;
}

function isTyping(target: EventTarget | null): boolean {
  return target instanceof HTMLSelectElement || (target instanceof HTMLInputElement && !["checkbox", "range"].includes(target.type));
}

/** Buttons at the start of the page that skip to the picture, and to the console or the participants. */
function skips(): void {
  at("skip-picture").addEventListener("click", () => at("picture").focus());
  at("skip-session").addEventListener("click", () => {
    const toggle = at("right-toggle");
    if (toggle.offsetParent !== null && toggle.getAttribute("aria-expanded") === "false") toggle.click();
    at("right").querySelector<HTMLElement>("section:not([hidden]) button")?.focus();
  });
}

function drawers(): void {
  const close = (side: string): void => {
    at(side).classList.remove("open");
    at(`${side}-toggle`).setAttribute("aria-expanded", "false");
  };
  for (const [side, other] of [["left", "right"], ["right", "left"]]) {
    at(`${side}-toggle`).addEventListener("click", () => {
      close(other);
      const isOpen = at(side).classList.toggle("open");
      at(`${side}-toggle`).setAttribute("aria-expanded", String(isOpen));
    });
  }
  at("stage").addEventListener("pointerdown", () => ["left", "right"].forEach(close));
}

export function listen(orders: Orders): void {
  const { orbit, palette } = orders;
  at("views").append(
    button("Fit", "Shows the whole model (key F)", () => orbit.fit()),
    ...VIEWS.map((view, i) => button(view.charAt(0).toUpperCase() + view.slice(1), `View (Shift + ${i + 1})`, () => orbit.standard(view))),
  );
  const help = at("help") as HTMLDialogElement;
  const table = make("table");
  for (const [key, text] of HELP) table.append(make("tr", {}, make("td", {}, make("kbd", { text: key })), make("td", { text })));
  help.append(make("h2", { text: "Keys and gestures" }), table, button("Close", "Closes the help", () => help.close()));
  at("help-toggle").addEventListener("click", () => help.showModal());
  drawers();
  skips();
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") orders.cancel();
    if (isTyping(event.target) || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]") !== null) return;
    const digit = /^(?:Digit|Numpad)([1-6])$/.exec(event.code)?.[1];
    if (digit !== undefined && event.shiftKey) orbit.standard(VIEWS[Number(digit) - 1]);
    else if (event.key === "f" || event.key === "F") orbit.fit();
    else if (event.key === "?") help.showModal();
    else if (orders.canUseTools()) {
      if (digit !== undefined && Number(digit) <= TOOL_KINDS.length) palette.choose(TOOL_KINDS[Number(digit) - 1]);
      else if (event.key === "[") palette.resize(-1);
      else if (event.key === "]") palette.resize(1);
      else if (event.key === "v" || event.key === "V") orders.switchMode();
      else return;
    } else return;
    event.preventDefault();
  });
}
