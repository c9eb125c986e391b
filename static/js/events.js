// The event stream: reconnects by itself, replays missed job events, says when it is lost and found.

/**
 * `handlers` has one for each kind of event; `open(again)` is told true when the stream had been lost, `lost` when it is.
 */
export function listen(visitor, { open, lost, ...handlers }) {
  let source = null;
  let wasOpen = false;
  let isLost = false;

  function connect() {
    source = new EventSource(`api/events?${new URLSearchParams({ frames: 1, visitor })}`);
    for (const [kind, handle] of Object.entries(handlers)) {
      source.addEventListener(kind, (event) => handle(JSON.parse(event.data)));
    }
    source.addEventListener("open", () => {
      open(wasOpen && isLost);
      wasOpen = true;
      isLost = false;
    });
    source.addEventListener("error", () => {
      if (!isLost) lost();
      isLost = true;
      if (source.readyState === EventSource.CLOSED) setTimeout(connect, 1000);
    });
  }

  connect();
}
