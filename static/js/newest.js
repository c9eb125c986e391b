// Fast changes by hand: one request at a time, and of what piles up meanwhile only the newest is sent.
import { toast } from "./toasts.js";

export class Newest {
  /** `send` is an async function of the value. */
  constructor(send) {
    this.send = send;
    this.isBusy = false;
    this.waiting = []; // at most one value
  }

  async ask(value) {
    this.waiting = [value];
    if (this.isBusy) return;
    this.isBusy = true;
    try {
      while (this.waiting.length) await this.send(this.waiting.pop());
    } catch (error) {
      this.waiting = [];
      toast(error.message, "error");
    } finally {
      this.isBusy = false;
    }
  }
}
