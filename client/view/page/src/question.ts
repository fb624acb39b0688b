// Asks before an act that takes something away from a participant.
import { at, setText } from "./element.ts";

/** Asks a question; resolves to whether it was confirmed. */
export function ask(question: string, confirm: string): Promise<boolean> {
  const dialog = at("question") as HTMLDialogElement;
  setText(at("question-text"), question);
  setText(at("question-yes"), confirm);
  dialog.returnValue = "";
  at("question-yes").onclick = () => dialog.close("yes");
  at("question-no").onclick = () => dialog.close("");
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}
