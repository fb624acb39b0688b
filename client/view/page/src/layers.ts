// Layers: regions to show, hide and make translucent, the clipping plane, and drawn extras.
import * as THREE from "three";
import { at, button, icon, make, setText } from "./element.ts";
import { STRAIN_MAX, strainGradient } from "./strain.ts";
import type { SpringFigures } from "./springs.ts";
import { colourOf } from "./materials.ts";
import type { Region } from "./messages.ts";
import type { Layer } from "./tissue.ts";

/** A padlock, the sign of a pinned region. */
const LOCK = "M5 11h14v10H5zM8 11V7a4 4 0 0 1 8 0v4";

type Axis = "x" | "y" | "z";

export class Layers {
  private readonly list = make("div");
  private readonly axis = make("select", { id: "clip-axis" });
  private readonly slider = make("input", { id: "clip-at", type: "range", min: 0, max: 1000, value: 500 });
  private readonly place = make("output", { for: "clip-at" });
  private readonly flip: HTMLButtonElement;
  private readonly springs = make("select", { id: "springs" });
  private readonly legend = make("div", { hidden: true });
  private readonly springFigures = make("output", { class: "hint", for: "springs" });
  private isFlipped = false;
  private bounds = new THREE.Box3();

  constructor(
    private readonly onLayers: () => void,
    private readonly onClip: (plane: THREE.Plane | null) => void,
    onForces: (isShown: boolean) => void,
    onSprings: (region: number | null) => void,
  ) {
    for (const [value, text] of [["", "off"], ["x", "across x"], ["y", "across y"], ["z", "across z"]]) {
      this.axis.append(make("option", { value, text }));
    }
    this.flip = button("Flip", "Remove the other side", () => {
      this.isFlipped = !this.isFlipped;
      this.flip.setAttribute("aria-pressed", String(this.isFlipped));
      this.clip();
    });
    this.axis.addEventListener("change", () => this.clip());
    this.slider.addEventListener("input", () => this.clip());
    const forces = make("input", { type: "checkbox", id: "forces", checked: true });
    forces.addEventListener("change", () => onForces(forces.checked));
    this.springs.addEventListener("change", () => {
      const region = this.springs.value === "" ? null : Number(this.springs.value);
      this.legend.hidden = region === null;
      setText(this.springFigures, "");
      onSprings(region);
    });
    const bar = make("div", { class: "strains" });
    bar.style.background = strainGradient();
    const percent = 100 * STRAIN_MAX;
    this.legend.append(
      bar,
      make("p", { class: "ticks" }, ...[`−${percent} %`, "strain 0", `+${percent} %`].map((text) => make("span", { text }))),
      this.springFigures,
    );
    at("layers").append(
      make("h2", { text: "Layers" }),
      this.list,
      make("h3", { text: "Clipping plane" }),
      make("div", { class: "row" }, make("label", { for: "clip-axis", text: "Plane" }), this.axis, this.flip),
      make("label", { for: "clip-at" }, "Position ", this.place),
      this.slider,
      make("h3", { text: "Drawn" }),
      make("div", { class: "row" }, forces, make("label", { for: "forces", text: "Forces and contacts" })),
      make("label", { for: "springs", text: "Springs at the surface of the region" }),
      this.springs,
      this.legend,
    );
    this.clip();
  }

  setRegions(regions: Region[], layers: Layer[]): void {
    const rows = regions.map((region, i) => {
      const visible = make("input", { type: "checkbox", id: `region-${i}`, checked: layers[i].isVisible });
      visible.addEventListener("change", () => {
        layers[i].isVisible = visible.checked;
        this.onLayers();
      });
      const opacity = make("input", {
        type: "range",
        min: 10,
        max: 100,
        step: 5,
        value: 100 * layers[i].opacity,
        "aria-label": `Opacity of ${region.name}, percent`,
        title: "Opacity",
      });
      opacity.addEventListener("input", () => {
        layers[i].opacity = Number(opacity.value) / 100;
        this.onLayers();
      });
      const swatch = make("span", { class: region.is_pinned ? "swatch pinned" : "swatch" });
      swatch.style.setProperty("--colour", colourOf(region.material));
      const title = `${region.name}: ${region.material}${region.is_pinned ? ", pinned in place" : ""}`;
      const name = make("label", { class: "name", for: `region-${i}`, text: region.name, title });
      if (region.is_pinned) name.append(" ", icon(LOCK), make("span", { class: "unseen", text: "pinned" }));
      return make("div", { class: "layer" }, visible, swatch, name, opacity);
    });
    this.list.replaceChildren(...rows);
    const chosen = this.springs.value;
    const options = regions.map((region, i) => make("option", { value: String(i), text: region.name }));
    this.springs.replaceChildren(make("option", { value: "", text: "off" }), ...options);
    this.springs.value = Number(chosen) < regions.length ? chosen : "";
  }

  /** Shows the figures of the displayed springs; null while none have come. */
  showSprings(figures: SpringFigures | null): void {
    if (this.legend.hidden) return;
    const percent = (strain: number): string => `${strain < 0 ? "−" : "+"}${Math.abs(100 * strain).toFixed(0)} %`;
    const text = figures && `${figures.count} springs${figures.isCutShort ? " (not all)" : ""}, ${percent(figures.least)} to ${percent(figures.greatest)}`;
    setText(this.springFigures, text ?? "waiting for the host");
  }

  setBounds(bounds: THREE.Box3): void {
    this.bounds = bounds;
    this.clip();
  }

  private clip(): void {
    const axis = this.axis.value as Axis | "";
    this.slider.disabled = this.flip.disabled = axis === "";
    if (axis === "" || this.bounds.isEmpty()) {
      setText(this.place, "");
      this.onClip(null);
      return;
    }
    const share = Number(this.slider.value) / 1000;
    const position = this.bounds.min[axis] + share * (this.bounds.max[axis] - this.bounds.min[axis]);
    setText(this.place, `${axis} = ${(1000 * position).toFixed(1)} mm`);
    // The near side of the usual oblique view goes first: low y, high x and z.
    const side = (axis === "y" ? 1 : -1) * (this.isFlipped ? -1 : 1);
    const normal = new THREE.Vector3();
    normal[axis] = side;
    this.onClip(new THREE.Plane(normal, -side * position));
  }
}
