// REST calls. Every failure is an ApiError whose message is a sentence for a person.

export class ApiError extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

async function problemOf(answer) {
  try {
    const problem = await answer.json();
    const details = (problem.errors ?? []).map((e) => `${e.pointer ?? e.parameter ?? ""} ${e.detail}`.trim());
    return [problem.detail, ...details].filter(Boolean).join(" ");
  } catch {
    return `The service answered ${answer.status}.`;
  }
}

async function call(method, path, body) {
  let answer;
  try {
    const headers = body === undefined ? {} : { "Content-Type": "application/json" };
    answer = await fetch(`api/${path}`, { method, headers, body: body === undefined ? undefined : JSON.stringify(body) });
  } catch {
    throw new ApiError("The service cannot be reached.", 0);
  }
  if (!answer.ok) throw new ApiError(await problemOf(answer), answer.status);
  return answer.status === 204 ? null : answer.json();
}

export const get = (path) => call("GET", path);
export const post = (path, body) => call("POST", path, body);
export const patch = (path, body) => call("PATCH", path, body);
export const remove = (path) => call("DELETE", path);
