// Plots of the last seconds: force of the selected participant and playout delay D.
import { at, make, setText } from "./element.ts";
import { Theme } from "./theme.ts";

const SPAN_MS = 20_000;
/** Interval between two points, ms. */
const STEP_MS = 100;

class Plot {
  private points: { at_ms: number; value: number }[] = [];
  private readonly value = make("strong");
  private readonly canvas: HTMLCanvasElement;
  private readonly name = make("span");

  constructor(
    parent: HTMLElement,
    private readonly unit: string,
    private readonly digits: number,
    private readonly least: number,
  ) {
    this.canvas = make("canvas", { role: "img" });
    parent.append(make("div", { class: "plot" }, make("p", {}, this.name, this.value), this.canvas));
  }

  clear(): void {
    this.points = [];
  }

  add(name: string, value: number, now_ms: number): void {
    setText(this.name, name);
    setText(this.value, `${value.toFixed(this.digits)}\u202f${this.unit}`);
    this.points.push({ at_ms: now_ms, value });
    while (this.points[0].at_ms < now_ms - SPAN_MS) this.points.shift();
    this.draw(now_ms);
  }

  private draw(now_ms: number): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const context = this.canvas.getContext("2d");
    if (context === null || width === 0) return;
    const ratio = Math.min(2, devicePixelRatio);
    if (this.canvas.width !== Math.round(width * ratio)) this.canvas.width = Math.round(width * ratio);
    if (this.canvas.height !== Math.round(height * ratio)) this.canvas.height = Math.round(height * ratio);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const peak = Math.max(...this.points.map((p) => p.value));
    const top = Math.max(this.least, nice(peak));
    const y = (value: number): number => height - 3 - (value / top) * (height - 8);
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = Theme.colour("--soft");
    context.strokeStyle = Theme.colour("--line");
    context.lineWidth = 1;
    for (const level of [0.5, 1]) {
      context.beginPath();
      context.moveTo(0, y(level * top));
      context.lineTo(width, y(level * top));
      context.stroke();
      context.fillText(`${+(level * top).toFixed(2)}`, 3, y(level * top) + 11);
    }
        context.strokeStyle = Theme.colour("--accent");
    context.lineWidth = 1.6;
    context.beginPath();
    for (const point of this.points) context.lineTo(width * (1 - (now_ms - point.at_ms) / SPAN_MS), y(point.value));
    context.stroke();
    this.canvas.setAttribute("aria-label", `${this.name.textContent}: now ${this.value.textContent}, highest ${peak.toFixed(this.digits)} ${this.unit}`);
  }
}

/** The next of 1, 2, 5 times a power of ten. */
export function nice(value: number): number {
  if (!(value > 0)) return 0;
  const power = 10 ** Math.floor(Math.log10(value));
  return ([1, 2, 5, 10].find((m) => m * power >= value * 0.999) ?? 10) * power;
}

export class Plots {
  private readonly force: Plot;
  private readonly delay: Plot;
  private plotted_ms = Number.NEGATIVE_INFINITY;

  constructor() {
    at("plots").append(make("h2", { text: "Last 20 seconds" }));
    this.force = new Plot(at("plots"), "N", 2, 1);
    this.delay = new Plot(at("plots"), "ms", 0, 20);
  }

  clear(): void {
    this.force.clear();
  }

  /** Whether the next point is due. */
  isDue(now_ms: number): boolean {
    return now_ms - this.plotted_ms >= STEP_MS;
  }

  add(who: string, force_n: number, delay_ms: number, now_ms: number): void {
    this.plotted_ms = now_ms;
    this.force.add(`Force on ${who}`, force_n, now_ms);
    this.delay.add("Playout delay D", delay_ms, now_ms);
  }
}
