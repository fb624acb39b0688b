// Waits between attempts to reconnect: 0.25 s, doubled up to 4 s, for 60 s, because the server keeps a seat for 60 s.

const FIRST_MS = 250;
const LAST_MS = 4000;
const TOTAL_MS = 60_000;

export class Retry {
  private wait_ms = FIRST_MS;
  private begun_ms: number | null = null;

  /** `wasJoined`: whether a session was joined before the loss. */
  constructor(readonly wasJoined = false) {}

  /** Starts the 60 s. */
  begin(now_ms: number): void {
    this.begun_ms ??= now_ms;
  }

  /** The wait before the next attempt, ms; null when the time is over. */
  next(now_ms: number): number | null {
    this.begin(now_ms);
    const wait = this.wait_ms;
    this.wait_ms = Math.min(2 * wait, LAST_MS);
    return now_ms + wait - this.begun_ms! > TOTAL_MS ? null : wait;
  }

  secondsLeft(now_ms: number): number {
    return this.begun_ms === null ? TOTAL_MS / 1000 : Math.max(0, Math.ceil((this.begun_ms + TOTAL_MS - now_ms) / 1000));
  }
}
