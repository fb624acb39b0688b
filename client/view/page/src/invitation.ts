// The invitation in the fragment of the page's address, and the seat that a reload keeps. The grant goes into the hello message
// and nowhere else.
import { type PageText, type Seat, type Tool, VERSION } from "./messages.ts";

const SEAT = "palpate-seat";

export interface Invitation {
  /** Null for a local client. */
  role: string | null;
  grant: string;
  name: string;
}

export function invitation(fragment: string): Invitation {
  const keys = new URLSearchParams(fragment.replace(/^#/, ""));
  return { role: keys.get("role"), grant: keys.get("grant") ?? "", name: (keys.get("name") ?? "").slice(0, 64) };
}

export function hello(from: Invitation, tool: Tool): Extract<PageText, { type: "hello" }> {
  if (from.role === null) return { type: "hello", version: VERSION, grant: from.grant };
  const holds = from.role === "trainee" || from.role === "instructor";
  return { type: "hello", version: VERSION, name: from.name, role: from.role, grant: from.grant, tool: holds ? tool : null, seat: null };
}

/** Takes the seat that this page had before a reload. It is removed, so that a copy of the page cannot take it as well. */
export function takeSeat(): Seat | null {
  const kept = sessionStorage.getItem(SEAT);
  sessionStorage.removeItem(SEAT);
  try {
    const seat: unknown = kept === null ? null : JSON.parse(kept);
    return typeof seat === "object" && seat !== null && "participant" in seat && "token" in seat ? (seat as Seat) : null;
  } catch {
    return null;
  }
}

/** Keeps the seat for a reload. */
export function keepSeat(seat: Seat | null): void {
  if (seat === null) sessionStorage.removeItem(SEAT);
  else sessionStorage.setItem(SEAT, JSON.stringify(seat));
}
