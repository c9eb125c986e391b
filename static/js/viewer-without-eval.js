// Runs in the 3D view's frame before its client. The client makes functions from strings: to sort Gaussian splats, of
// which we show none, and to run scripts that messages may hold. The frame's policy forbids that with an error; here such
// functions do nothing.
(() => {
  const nothing = () => () => {};
  window.Function = new Proxy(Function, { apply: () => nothing, construct: () => nothing });
})();
