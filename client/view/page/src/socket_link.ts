// The connection by a WebSocket.
import type { Link, LinkEvents } from "./link.ts";
import { SUBPROTOCOL } from "./messages.ts";

export class SocketLink implements Link {
  readonly transport = "WebSocket";
  private readonly socket: WebSocket;

  constructor(
    url: string,
    private events: LinkEvents | null,
  ) {
    this.socket = new WebSocket(url, SUBPROTOCOL);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.events?.open(this);
    this.socket.onmessage = (event: MessageEvent<string | ArrayBuffer>) => {
      if (typeof event.data === "string") this.events?.text(event.data);
      else this.events?.binary(event.data, true);
    };
    this.socket.onclose = (event) => this.events?.close(event.code, event.reason);
  }

  sendText(text: string): void {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(text);
  }

  sendFrame(frame: ArrayBuffer): void {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(frame);
  }

  close(): void {
    this.events = null;
    this.socket.close();
  }
}
