// REST calls. Every failure is an ApiError whose message is a sentence for a person.

const CALLED = "osf-visitor";

/** The name of before where the page is only loaded again: who drove goes on driving. A duplicated tab is another page. */
function ownName() {
  const kept = performance.getEntriesByType("navigation")[0]?.type === "reload" && sessionStorage.getItem(CALLED);
  // Not crypto.randomUUID: browsers keep that for secure pages, and this one may come from another machine.
  const name = kept || [...crypto.getRandomValues(new Uint8Array(12))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  sessionStorage.setItem(CALLED, name);
  return name;
}

// What this page calls itself; the service takes no changes from one that only watches.
export const VISITOR = ownName();
const SIGNED = { "X-OSF-Visitor": VISITOR };

export class ApiError extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

/** The sentence of an answer that is an error. */
export async function problemOf(answer) {
  try {
    return (await answer.json()).detail || `The service answered ${answer.status}.`;
  } catch {
    return `The service answered ${answer.status}.`;
  }
}

let underway = 0; // calls that have not been answered yet

async function call(method, path, body) {
  let answer;
  underway += 1;
  try {
    const headers = body === undefined ? SIGNED : { ...SIGNED, "Content-Type": "application/json" };
    answer = await fetch(`api/${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch {
    throw new ApiError("The service cannot be reached.", 0);
  } finally {
    underway -= 1;
  }
  if (answer.status === 404) throw new ApiError("It is not there any more; somebody has deleted it.", 404);
  if (!answer.ok) throw new ApiError(await problemOf(answer), answer.status);
  return answer.status === 204 ? null : answer.json();
}

/** Sends a file; `onProgress` is told the share that has been sent. */
export function upload(path, file, onProgress = () => {}, type = "application/zip") {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest(); // fetch tells no progress of what it sends
    request.open("POST", `api/${path}`);
    request.setRequestHeader("Content-Type", type);
    for (const [name, value] of Object.entries(SIGNED)) request.setRequestHeader(name, value);
    request.upload.addEventListener("progress", (event) => event.lengthComputable && onProgress(event.loaded / event.total));
    request.addEventListener("error", () => reject(new ApiError("The service cannot be reached, or refused a file of this size.", 0)));
    request.addEventListener("load", async () => {
      const answer = new Response(request.responseText, { status: request.status });
      if (answer.ok) resolve(await answer.json());
      else reject(new ApiError(await problemOf(answer), answer.status));
    });
    request.send(file);
  });
}

const QUIET_MS = 60;

/** Resolves once the service has answered all calls and nothing more is asked of it for a moment. */
export async function allAnswered() {
  for (let quiet = 0; quiet < 2; quiet = underway ? 0 : quiet + 1) await new Promise((resolve) => setTimeout(resolve, QUIET_MS));
}

export const get = (path) => call("GET", path);
/** All entries of a list, page by page; only for lists that stay short. */
export async function getAll(path, key) {
  const entries = [];
  for (let after = {}; after; ) {
    const answer = await get(`${path}?${new URLSearchParams({ limit: 500, ...after })}`);
    entries.push(...answer[key]);
    after = answer.next === null ? null : { after: answer.next };
  }
  return entries;
}
export const post = (path, body) => call("POST", path, body);
export const put = (path, body) => call("PUT", path, body);
export const patch = (path, body) => call("PATCH", path, body);
export const remove = (path) => call("DELETE", path);
