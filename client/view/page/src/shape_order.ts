// Order of shapes that arrive on streams of their own. A change needs the shape before it, and a shape the surface of its
// topology. The host drops late changes and sends a full shape instead.
import type { Shape } from "./messages.ts";

/** Shapes that wait for an earlier one, 2 s of them. */
const WAITING_MAX = 64;

export class ShapeOrder {
  private last = -1;
  private version = -1;
  private readonly waiting = new Map<number, Shape>();

  constructor(private readonly deliver: (shape: Shape) => void) {}

  /** Shapes of this topology can be displayed from now on. */
  addSurface(version: number): void {
    this.version = version;
    this.drain();
  }

  add(shape: Shape): void {
    if (shape.number <= this.last) return;
    this.waiting.set(shape.number, shape);
    this.drain();
    if (this.waiting.size > WAITING_MAX) this.waiting.delete(Math.min(...this.waiting.keys()));
  }

  private drain(): void {
    for (let next = this.next(); next !== undefined; next = this.next()) {
      this.last = next.number;
      for (const number of this.waiting.keys()) if (number <= this.last) this.waiting.delete(number);
      this.deliver(next);
    }
  }

  /** The shape after the last one, or else the first full one. */
  private next(): Shape | undefined {
    const isKnown = (shape: Shape): boolean => shape.version <= this.version;
    const following = this.waiting.get(this.last + 1);
    if (following !== undefined && this.last >= 0 && isKnown(following)) return following;
    const full = [...this.waiting.values()].filter((shape) => shape.nodes === null && isKnown(shape));
    return full.sort((a, b) => a.number - b.number)[0];
  }
}
