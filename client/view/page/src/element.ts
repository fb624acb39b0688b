// Creates elements of the page. Text is always set as text, never as markup.

type Value = string | number | boolean | null | ((event: never) => void);

/** Creates an element: `text` is its text, `on...` are listeners, `true` sets an attribute without a value. */
export function make<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Record<string, Value> = {},
  ...children: (Node | string | null)[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") element.textContent = String(value);
    else if (typeof value === "function") element.addEventListener(name.slice(2), value as EventListener);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null) element.setAttribute(name, String(value));
  }
  for (const child of children) if (child !== null) element.append(child);
  return element;
}

/** A drawing of one line in a square of 24 units. */
export function icon(path: string): SVGElement {
  const space = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("viewBox", "0 0 24 24");
  svg.setAttribute("aria-hidden", "true");
  const line = document.createElementNS(space, "path");
  line.setAttribute("d", path);
  svg.append(line);
  return svg;
}

/** The element of the page with this id. */
export function at(id: string): HTMLElement {
  const element = document.getElementById(id);
  if (element === null) throw new Error(`the page has no element ${id}`);
  return element;
}

/** A button of the page. */
export function button(text: string, title: string, onclick: () => void): HTMLButtonElement {
  return make("button", { type: "button", text, title, onclick });
}

/** Sets the text of an element if it differs, so that screen readers and layout see changes only. */
export function setText(element: HTMLElement, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

/** A number with digits after the point and a unit, or a dash if it is unknown. */
export function figure(value: number | null | undefined, digits: number, unit: string): string {
  return value === null || value === undefined ? "–" : `${value.toFixed(digits)}\u202f${unit}`;
}
