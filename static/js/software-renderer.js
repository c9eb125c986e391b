// Runs in the 3D view's frame before its client. Where no graphics card draws, pictures cost the processor that also
// looks and plans: they come without smoothed edges and no faster than the page allows (`framesPerSecond`).
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

  function limitFrameRate() {
    const natively = window.requestAnimationFrame.bind(window);
    let waiting = new Map();
    let last = 0;
    let id = 0;
    const draw = (now) => {
      const due = waiting;
      waiting = new Map();
      last = now;
      for (const callback of due.values()) callback(now);
    };
    window.requestAnimationFrame = (callback) => {
      const rest = last + 1000 / window.framesPerSecond - performance.now();
      if (!waiting.size) setTimeout(() => natively(draw), Math.max(rest, 0));
      waiting.set((id += 1), callback);
      return id;
    };
    window.cancelAnimationFrame = (number) => waiting.delete(number);
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
  limitFrameRate();
  closeNotice();
})();
