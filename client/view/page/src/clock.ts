// Offset of the server's clock, from the fastest of the recent round trips: a queue only ever lengthens a round trip, so the
// fastest one is the most symmetric.

const KEPT = 16;

interface RoundTrip {
  rtt_ms: number;
  offset_us: number;
}

export class ClockEstimate {
  private readonly recent: RoundTrip[] = [];

  /** Adds the round trip of a ping; `sent_ms` and `received_ms` are of the page's clock. */
  add(sent_ms: number, received_ms: number, server_us: number): void {
    const rtt_ms = received_ms - sent_ms;
    if (!(rtt_ms >= 0)) return;
    this.recent.push({ rtt_ms, offset_us: server_us - 500 * (sent_ms + received_ms) });
    if (this.recent.length > KEPT) this.recent.shift();
  }

  private fastest(): RoundTrip | null {
    return this.recent.reduce<RoundTrip | null>((best, r) => (best === null || r.rtt_ms < best.rtt_ms ? r : best), null);
  }

  /** Server time minus the page's time, µs; null before the first round trip. */
  offset_us(): number | null {
    return this.fastest()?.offset_us ?? null;
  }

  /** The last round trip, ms. */
  rtt_ms(): number | null {
    return this.recent.at(-1)?.rtt_ms ?? null;
  }
}
