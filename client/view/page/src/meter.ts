// Rate of the pictures and the time from a solve to its picture.

const SPAN_MS = 2000;

export class Meter {
  private pictures: number[] = [];
  private latencies: { at_ms: number; ms: number }[] = [];
  /** Time from opening the page to the first picture of the tissue, ms. */
  first_picture_ms: number | null = null;

  picture(now_ms: number): void {
    this.pictures.push(now_ms);
    while (this.pictures[0] < now_ms - SPAN_MS) this.pictures.shift();
  }

  /** Notes that a solve at this wall time (ms since 1970) is drawn now. */
  drawn(solved_ms: number, now_ms: number): void {
    this.latencies.push({ at_ms: now_ms, ms: performance.timeOrigin + now_ms - solved_ms });
    while (this.latencies[0].at_ms < now_ms - SPAN_MS) this.latencies.shift();
  }

  get fps(): number {
    const span = this.pictures.length < 2 ? 0 : this.pictures[this.pictures.length - 1] - this.pictures[0];
    return span === 0 ? 0 : (1000 * (this.pictures.length - 1)) / span;
  }

  /** Median and maximum over the last 2 s, ms; null without any. */
  get latency_ms(): { median: number; max: number } | null {
    const recent = this.latencies.filter((l) => l.at_ms > performance.now() - SPAN_MS).map((l) => l.ms);
    if (recent.length === 0) return null;
    recent.sort((a, b) => a - b);
    return { median: recent[recent.length >> 1], max: recent[recent.length - 1] };
  }
}
