// The event stream: reconnects by itself, replays missed job events, says when it is lost and found.

/**
 * handlers: { job, scene, frame, notice, open(again), lost } - `again` is true when the stream had been lost.
 */
export function listen(handlers) {
  let source = null;
  let wasOpen = false;
  let isLost = false;

  function connect() {
    source = new EventSource("api/events?frames=1");
    for (const kind of ["job", "scene", "frame", "notice"]) {
      source.addEventListener(kind, (event) => handlers[kind](JSON.parse(event.data)));
    }
    source.addEventListener("open", () => {
      handlers.open(wasOpen && isLost);
      wasOpen = true;
      isLost = false;
    });
    source.addEventListener("error", () => {
      if (!isLost) handlers.lost();
      isLost = true;
      if (source.readyState === EventSource.CLOSED) setTimeout(connect, 1000);
    });
  }

  connect();
}
