// What an episode came to, in one line.

export const length = (mm) => (mm < 10 ? `${mm.toFixed(1)} mm` : `${(mm / 10).toFixed(1)} cm`);
export const NOT_KNOWN = "not known: this method looks at images alone";
/** By object; null where nobody knows. */
export const offsets = (step) => step.truly_to_goal_mm ?? step.to_goal_mm;
export const farthest = (step) => (offsets(step) ? Math.max(...Object.values(offsets(step))) : null);
const cost = (step) => Number((1000 * step.image_cost).toPrecision(2));

/** The last round that was over after so many actions; a round may have several. */
export const roundAt = (steps, actions) => Math.max(steps.findLastIndex(({ step }) => step <= actions), 0);

export const pushes = ({ done }) => `${done} ${done === 1 ? "push" : "pushes"}`;
/** "95 s", without pauses; "" where that is not known. */
export const took = ({ seconds }) => (Number.isFinite(seconds) ? `${seconds.toFixed(0)} s` : "");

/** What it came to: [distance, pushes, time, light], "" for what is not known. */
export function parts(episode) {
  const { steps } = episode;
  const [first, last] = [steps[0], steps.at(-1)];
  const light = first.light_off_deg === null || first.light_off_deg === undefined ? "" : `light found to ${first.light_off_deg.toFixed(1)}°`;
  const distance = offsets(last) ? `${length(farthest(first))} to ${length(farthest(last))}` : NOT_KNOWN;
  return [distance, pushes(episode), took(episode), light];
}

/** "9.3 cm to 2 mm, 18 pushes, 95 s, light found to 0.2°"; the image cost where distances are not known. */
export function summary(episode) {
  const { steps } = episode;
  const [distance, ...rest] = parts(episode);
  const came = distance === NOT_KNOWN ? `image cost ${cost(steps[0])} to ${cost(steps.at(-1))} · 10⁻³` : distance;
  return [came, ...rest].filter(Boolean).join(", ");
}
