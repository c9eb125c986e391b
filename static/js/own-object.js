// A mesh of one's own: chosen or dropped, sized, sent, and made an object by a job.
import { upload } from "./api.js";
import { byId } from "./dom.js";
import { glbSize } from "./glb-size.js";
import { sizeText } from "./objects.js";
import { showJob } from "./jobs.js";
import { objects } from "./state.js";
import { scrollTo, showTab } from "./tabs.js";

const LIKELY_M = [0.03, 0.6]; // longest side of most things on a table
const MOST_NAME = 60;
let chosen = null;
let size = null; // in the file's unit, if it is known
let suggested = ""; // the name that the file gave

const form = () => byId("new-object");
const scale = () => Number(form().elements.unit.value);
const bareName = (name) => name.replace(/\.[^.]*$/, "").replace(/[_-]+/g, " ").trim();

/** Whether a file is meant to be an object. */
export const isMesh = (file) => /\.(glb|zip|obj|gltf|ply|stl|off)$/i.test(file.name);

function tell(text, isError = false) {
  byId("own-object-error").hidden = !isError;
  byId("own-object-error").textContent = isError ? text : "";
  byId("own-object-state").textContent = isError ? "" : text;
}

function drawSize() {
  if (!chosen) return;
  if (!size) {
    tell(`${chosen.name} is measured when it has been sent.`);
    return;
  }
  const metres = size.map((side) => side * scale());
  const fits = Math.max(...metres) >= 0.005 && Math.max(...metres) <= 1;
  tell(`${chosen.name} is ${sizeText(metres)}${fits ? "." : ": choose another unit; objects are between 5 mm and 1 m long."}`);
}

/** The unit in which the mesh would be of an object's size, the file's standard one first. */
function guessUnit() {
  const longest = Math.max(...size);
  const units = [...form().elements.unit.options].map((option) => option.value);
  const likely = units.find((unit) => longest * unit >= LIKELY_M[0] && longest * unit <= LIKELY_M[1]);
  if (likely) form().elements.unit.value = likely;
}

/** Takes a file into the form and shows that. */
export async function takeMesh(file) {
  showTab("objects");
  scrollTo(form().closest(".card"));
  chosen = file;
  byId("own-object-file-name").textContent = file.name;
  const { label } = form().elements;
  if (!label.value || label.value === suggested) label.value = suggested = bareName(file.name).slice(0, MOST_NAME);
  size = await glbSize(file);
  if (chosen !== file) return;
  if (size) guessUnit();
  drawSize();
  form().querySelector("[type=submit]").focus({ preventScroll: true });
}

/** A name for scenes, made from that for people. */
function nameFrom(label) {
  const plain = label.normalize("NFKD").toLowerCase().replace(/[^a-z0-9]+/g, "_").replace(/^_+|_+$/g, "");
  const base = (plain || "object").slice(0, MOST_NAME);
  const taken = new Set(objects().map((object) => object.name));
  for (let number = 1; ; number += 1) {
    const name = number === 1 ? base : `${base}_${number}`;
    if (!taken.has(name)) return name;
  }
}

async function send() {
  if (!chosen) throw new Error("Choose a file first: a GLB, PLY or STL, or a zip of an OBJ with its MTL and texture.");
  const { label, grams } = form().elements;
  const query = new URLSearchParams({
    name: nameFrom(label.value), label: label.value.trim(), scale: scale(), file_name: chosen.name.slice(-200),
  });
  if (grams.value) query.set("mass_kg", Number(grams.value) / 1000);
  const bar = byId("own-object-bar");
  bar.hidden = false;
  bar.value = 0;
  tell(`Sending ${chosen.name}`);
  const types = { zip: "application/zip", glb: "model/gltf-binary" };
  const type = types[chosen.name.split(".").at(-1).toLowerCase()] ?? "application/octet-stream";
  try {
    showJob(await upload(`objects?${query}`, chosen, (share) => { bar.value = share; }, type));
    scrollTo(byId("object-work")); // where the work is told, and then the next step
    tell("");
  } finally {
    bar.hidden = true;
  }
}

async function submit(event) {
  event.preventDefault();
  const button = form().querySelector("[type=submit]");
  if (button.disabled) return;
  button.disabled = true;
  try {
    await send();
  } catch (error) {
    tell(error.message, true);
  } finally {
    button.disabled = false;
  }
}

/** Empties the form once the object of its file is there; by then it may hold the next one. */
export function clearMesh(file) {
  if (chosen && chosen.name !== file) return;
  form().reset();
  [chosen, size, suggested] = [null, null, ""];
  byId("own-object-file-name").textContent = "or drop it anywhere";
  tell("");
}

export function setUpOwnObject() {
  const file = byId("own-object-file");
  byId("choose-mesh").addEventListener("click", () => file.click());
  file.addEventListener("change", () => {
    const [first] = file.files;
    if (first) takeMesh(first);
    file.value = "";
  });
  form().addEventListener("submit", submit);
  form().elements.unit.addEventListener("change", drawSize);
}
