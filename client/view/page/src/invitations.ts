// The instructor's invitations: a form, the addresses of the newest one, and the list of open ones.
import { button, make, setText } from "./element.ts";
import type { Act, InvitationAddresses, OpenInvitation } from "./messages.ts";
import { drawing } from "./qr.ts";

const ROLES = ["trainee", "spectator", "recorder", "instructor"];
const UNITS: [string, number][] = [["minutes", 60], ["hours", 3600], ["days", 86_400]];
const LIFETIME_MAX_S = 30 * 86_400;
const COPIED_MS = 2000;

/** Time that is left, in its largest unit; null if none is. */
export function remaining(us: number): string | null {
  const s = Math.ceil(us / 1e6);
  if (s <= 0) return null;
  if (s < 60) return `${s}\u202fs`;
  if (s < 3600) return `${Math.floor(s / 60)}\u202fmin ${s % 60}\u202fs`;
  if (s < 86_400) return `${Math.floor(s / 3600)}\u202fh ${Math.floor((s % 3600) / 60)}\u202fmin`;
  return `${Math.floor(s / 86_400)}\u202fd ${Math.floor((s % 86_400) / 3600)}\u202fh`;
}

interface Row {
  root: HTMLElement;
  left: HTMLElement;
  expires_us: number;
}

export class Invitations {
  readonly root = make("div");
  private readonly role = make("select", { id: "invite-role" });
  private readonly name = make("input", { id: "invite-name", class: "grow", maxlength: 64, placeholder: "any", autocomplete: "off" });
  private readonly lifetime = make("input", { type: "number", id: "invite-lifetime", min: 1, step: 1, value: 1 });
  private readonly unit = make("select", { id: "invite-unit" });
  private readonly single = make("input", { type: "checkbox", id: "invite-single" });
  private readonly newest = make("div", { id: "invitation", role: "group", "aria-label": "New invitation", hidden: true });
  private readonly list = make("div", { id: "invitations" });
  private readonly rows = new Map<number, Row>();
  private shown: number | null = null;

  /** `serverTime_us` reads the clock of the server; null while it is unknown. */
  constructor(
    private readonly send: (act: Act) => void,
    private readonly serverTime_us: () => number | null,
  ) {
    for (const role of ROLES) this.role.append(make("option", { value: role, text: role }));
    for (const [unit, s] of UNITS) this.unit.append(make("option", { value: s, text: unit, selected: unit === "hours" }));
    this.unit.setAttribute("aria-label", "Unit of the lifetime");
    this.single.checked = true;
    this.root.append(
      make("h3", { text: "Invitations" }),
      make("div", { class: "row" }, make("label", { for: "invite-role", text: "Role" }), this.role),
      make("div", { class: "row" }, make("label", { for: "invite-name", text: "Name" }), this.name),
      make("div", { class: "row" }, make("label", { for: "invite-lifetime", text: "Valid for" }), this.lifetime, this.unit),
      make(
        "div",
        { class: "row" },
        this.single,
        make("label", { for: "invite-single", class: "grow", text: "Single use" }),
        button("Invite", "Creates a link for this role", () => this.invite()),
      ),
      this.newest,
      this.list,
    );
    setInterval(() => this.count(), 1000);
  }

  private invite(): void {
    const lifetime_s = Math.round(this.lifetime.valueAsNumber * Number(this.unit.value));
    const isValid = lifetime_s >= 60 && lifetime_s <= LIFETIME_MAX_S;
    this.lifetime.setCustomValidity(isValid ? "" : "An invitation is valid for 1 minute to 30 days.");
    if (!this.lifetime.reportValidity()) return;
    const name = this.name.value.trim();
    this.send({ act: "invite", role: this.role.value, name: name === "" ? null : name, lifetime_s, is_single_use: this.single.checked });
  }

  /** Shows the addresses of a new invitation, which come once. */
  showNewest({ id, link, url }: InvitationAddresses): void {
    this.shown = id;
    const about = `invitation ${id}`;
    this.newest.replaceChildren(
      make("p", { class: "hint", text: `Addresses of ${about}. They are shown only now.` }),
      ...(url === null ? [] : [address("invitation-url", "Page", url)]),
      address("invitation-link", "Link for programs", link),
      drawing(url ?? link, `QR code of ${about}`),
      make("div", { class: "row" }, button("Hide", "Hides the addresses", () => this.hide())),
    );
    this.newest.hidden = false;
  }

  private hide(): void {
    this.shown = null;
    this.newest.hidden = true;
    this.newest.replaceChildren();
  }

  /** Shows the open invitations. */
  show(open: readonly OpenInvitation[]): void {
    for (const [id, row] of this.rows) {
      if (open.some((invitation) => invitation.id === id)) continue;
      row.root.remove();
      this.rows.delete(id);
      if (id === this.shown) this.hide();
    }
    for (const invitation of open) {
      if (this.rows.has(invitation.id)) continue;
      const row = this.row(invitation);
      this.rows.set(invitation.id, row);
      this.list.append(row.root);
    }
    this.count();
  }

  private row({ id, role, name, is_single_use, expires_us }: OpenInvitation): Row {
    const left = make("span", { class: "role" });
    const words = [`${id}: ${role}`, name, is_single_use ? "single use" : null].filter((word) => word !== null);
    const revoke = button("Revoke", "Refuses every further join with it", () => this.send({ act: "revoke_invitation", id }));
    revoke.setAttribute("aria-label", `Revoke invitation ${id}`);
    const root = make("div", { class: "row invited" }, make("span", { class: "grow", text: words.join(" · ") }), left, revoke);
    return { root, left, expires_us };
  }

  /** Counts the lifetimes down. Clients drop expired invitations on their own. */
  private count(): void {
    const now_us = this.serverTime_us();
    if (now_us === null) return;
    for (const [id, row] of this.rows) {
      const left = remaining(row.expires_us - now_us);
      row.root.hidden = left === null;
      setText(row.left, left ?? "");
      if (left === null && id === this.shown) this.hide();
    }
  }
}

/** A text that can be copied, with its label. */
function address(id: string, label: string, text: string): HTMLElement {
  const field = make("input", { id, class: "grow", readonly: true, value: text });
  const copy = button("Copy", `Copies the address: ${label}`, () => void copyFrom(field, copy));
  return make("div", { class: "row" }, make("label", { for: id, text: label }), field, copy);
}

async function copyFrom(field: HTMLInputElement, copy: HTMLButtonElement): Promise<void> {
  field.select();
  try {
    await navigator.clipboard.writeText(field.value);
  } catch {
    // Browsers have no clipboard for pages without HTTPS; the older command works there.
    document.execCommand("copy");
  }
  setText(copy, "Copied");
  setTimeout(() => setText(copy, "Copy"), COPIED_MS);
}
