// Runs in the 3D view's frame before its client. Where no graphics card draws, pictures cost the processor that also
// looks and plans: they come without smoothed edges, no faster than the page allows (`framesPerSecond`), and only while
// something moves.
(() => {
  const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;

  function rendererName() {
    const gl = document.createElement("canvas").getContext("webgl2");
    const info = gl?.getExtension("WEBGL_debug_renderer_info");
    const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return name;
  }

  function dropSmoothing() {
    const original = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function getContext(kind, options) {
      return original.call(this, kind, kind.startsWith("webgl") ? { ...options, antialias: false } : options);
    };
  }

  // After the last thing that changed the view: pictures at the page's pace, for what eases out and loads; then a few
  // more, for what takes longer; then none.
  const [LIVELY_MS, SLOW_MS] = [1500, 10_000];
  const SLOW_INTERVAL_MS = 1000;

  /** Calls `wake` whenever the view may change: messages of the service come through a worker, hands by events. */
  function watchChanges(wake) {
    const Native = window.Worker;
    window.Worker = class extends Native {
      constructor(...args) {
        super(...args);
        this.addEventListener("message", wake);
      }
    };
    const inputs = ["pointerdown", "pointermove", "pointerup", "wheel", "keydown", "keyup", "resize", "focus", "load"];
    for (const kind of inputs) window.addEventListener(kind, wake, { capture: true, passive: true });
    document.addEventListener("visibilitychange", wake);
    new MutationObserver(wake).observe(document, { childList: true, subtree: true }); // the client's own panels
  }

  function limitFrames() {
    const natively = window.requestAnimationFrame.bind(window);
    let waiting = new Map();
    let [last, changed, timer, id] = [0, performance.now(), 0, 0];
    const draw = (now) => {
      const due = waiting;
      waiting = new Map();
      last = now;
      timer = 0;
      for (const callback of due.values()) callback(now);
    };
    const plan = () => {
      const now = performance.now();
      if (timer || !waiting.size || now - changed > SLOW_MS) return;
      const interval = now - changed < LIVELY_MS ? 1000 / window.framesPerSecond : SLOW_INTERVAL_MS;
      timer = setTimeout(() => natively(draw), Math.max(last + interval - now, 0));
    };
    window.requestAnimationFrame = (callback) => {
      waiting.set((id += 1), callback);
      plan();
      return id;
    };
    window.cancelAnimationFrame = (number) => waiting.delete(number);
    watchChanges(() => {
      const rests = performance.now() - changed > LIVELY_MS;
      changed = performance.now();
      if (rests) { // a slow picture may be far off
        clearTimeout(timer);
        timer = 0;
      }
      plan();
    });
  }

  /**
   * Messages of the service change nodes as soon as they come. Else the client takes them as it draws: what moves is in
   * that picture, what comes and goes in the next one, so that old things stand on a new table for as long as a picture
   * takes. That it does only while its tab is in view.
   */
  function takeMessagesBeforeDrawing() {
    Object.defineProperty(document, "hidden", { get: () => true });
  }

  /** The client's notice of this covers a corner of the table; what it warns of is seen to here. */
  function closeNotice() {
    const observer = new MutationObserver(() => {
      const titles = [...document.querySelectorAll("[class*=Notification-title]")];
      const notice = titles.find((title) => title.textContent.startsWith("Software WebGL"))?.closest("[class*=Notification-root]");
      if (!notice) return;
      notice.querySelector("button")?.click();
      observer.disconnect();
    });
    observer.observe(document, { childList: true, subtree: true });
    setTimeout(() => observer.disconnect(), 60_000);
  }

  window.framesPerSecond = 12;
  if (!SOFTWARE.test(rendererName())) return;
  dropSmoothing();
  limitFrames();
  takeMessagesBeforeDrawing();
  closeNotice();
})();
