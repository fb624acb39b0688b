// A QR code as an SVG drawing, without styles in it, because the page's policy permits none.
import qrcode from "qrcode-generator";

/** Light modules around the code, which readers need to find it. */
const QUIET = 4;

/** Path of the dark modules, one unit per module, and the width of the drawing in units. */
export function modules(text: string): { path: string; width: number } {
  // The smallest size that holds the text; the level M restores 15 % of damaged modules.
  const code = qrcode(0, "M");
  code.addData(text, "Byte");
  code.make();
  const count = code.getModuleCount();
  let path = "";
  for (let row = 0; row < count; row += 1) {
    for (let column = 0; column < count; column += 1) {
      if (code.isDark(row, column)) path += `M${column + QUIET} ${row + QUIET}h1v1h-1z`;
    }
  }
  return { path, width: count + 2 * QUIET };
}

/** A drawing of the code of a text. */
export function drawing(text: string, label: string): SVGElement {
  const space = "http://www.w3.org/2000/svg";
  const { path, width } = modules(text);
  const svg = document.createElementNS(space, "svg");
  svg.setAttribute("class", "qr");
  svg.setAttribute("viewBox", `0 0 ${width} ${width}`);
  svg.setAttribute("shape-rendering", "crispEdges");
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", label);
  const dark = document.createElementNS(space, "path");
  dark.setAttribute("d", path);
  svg.append(dark);
  return svg;
}
