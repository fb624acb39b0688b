// Light and dark: follows the system until the switch is used, and remembers the choice.
import { at, setText } from "./element.ts";

const KEY = "palpate-theme";

export class Theme {
  private readonly system = matchMedia("(prefers-color-scheme: dark)");

  constructor(private readonly onChange: () => void) {
    this.system.addEventListener("change", () => this.apply());
    at("theme").addEventListener("click", () => {
      localStorage.setItem(KEY, this.isDark ? "light" : "dark");
      this.apply();
    });
    this.apply();
  }

  get isDark(): boolean {
    const chosen = localStorage.getItem(KEY);
    return chosen === null ? this.system.matches : chosen === "dark";
  }

  private apply(): void {
    document.documentElement.dataset.theme = this.isDark ? "dark" : "light";
    setText(at("theme"), this.isDark ? "Light" : "Dark");
    this.onChange();
  }

  /** A colour of the page. */
  static colour(name: string): string {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  }
}
