// What an episode came to, in one line.

export const length = (mm) => (mm < 10 ? `${mm.toFixed(1)} mm` : `${(mm / 10).toFixed(1)} cm`);
export const offsets = (step) => step.truly_to_goal_mm ?? step.to_goal_mm;
export const farthest = (step) => Math.max(...Object.values(offsets(step)));

/** What it came to: [distance, pushes, time, light], "" for what is not known. */
export function parts({ steps, done, started_at: started, finished_at: finished }) {
  const [first, last] = [steps[0], steps.at(-1)];
  const seconds = started && finished ? `${((new Date(finished) - new Date(started)) / 1000).toFixed(0)} s` : "";
  const light = first.light_off_deg === null || first.light_off_deg === undefined ? "" : `light found to ${first.light_off_deg.toFixed(1)}°`;
  return [`${length(farthest(first))} to ${length(farthest(last))}`, `${done} ${done === 1 ? "push" : "pushes"}`, seconds, light];
}

/** "9.3 cm to 2 mm, 18 pushes, 95 s, light found to 0.2°". */
export const summary = (episode) => parts(episode).filter(Boolean).join(", ");
