// Small helpers to find and build elements. Text only ever enters as text.

export const byId = (id) => document.getElementById(id);

/** An element with properties, `data-`/ARIA attributes under `attributes`, listeners under `on`, and children. */
export function el(tag, { attributes = {}, on = {}, ...properties } = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  for (const [name, listener] of Object.entries(on)) node.addEventListener(name, listener);
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

/** Shows on a bar how much of a file has been sent; once all has, it only says that it goes on. */
export const shareOn = (bar) => (share) => {
  bar.value = share;
  if (share === 1) bar.removeAttribute("value");
};

/** Runs an async action with its button disabled meanwhile. */
export async function whileDisabled(button, action) {
  if (button.disabled) return;
  button.disabled = true;
  try {
    await action();
  } finally {
    button.disabled = false;
  }
}
