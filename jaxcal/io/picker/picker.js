"use strict";
// Pixel centres lie at integers: the first pixel covers -1/2 to 1/2.
const ZOOM = 8, NUDGE = 0.25;
const of = (id) => document.getElementById(id);
const frame = of("frame"), loupe = of("loupe");
let state = null, index = 0, image = null, scale = 1, ended = false, busy = Promise.resolve();
const images = new Map();

// The numbers of a folder's images count from 0, their names need not.
const named = (k) => state.files[k] ?? `frame ${state.shown[k]}`;

function load(k) {
  const number = state.shown[k];
  if (number === undefined) return null;
  if (!images.has(number)) {
    const made = new Image();
    made.onload = () => { if (made === image) draw(); };
    made.onerror = () => {
      images.delete(number);
      if (made === image) trouble(`${named(k)} cannot be shown`);
    };
    made.src = `frame/${number}.png`;
    images.set(number, made);
    if (images.size > 24) images.delete(images.keys().next().value);
  }
  return images.get(number);
}

function trouble(words) { of("trouble").textContent = words; }

function show(k) {
  index = Math.max(0, Math.min(k, state.shown.length - 1));
  image = load(index);
  load(index + 1);
  tell();
  draw();
}

function tell() {
  const number = state.shown[index], picked = Object.keys(state.points).length;
  const point = state.points[number];
  of("name").textContent = state.name;
  of("where").textContent = ended ? "Finished. You may close this page."
    : `${named(index)} (${index + 1} of ${state.shown.length}), `
      + `${picked} picked, ${state.skipped.length} skipped`
      + (point ? `, here at ${point[0].toFixed(2)}, ${point[1].toFixed(2)} px`
        : state.skipped.includes(number) ? ", skipped here" : "")
      + (state.next === null ? ". All done: finish, or look back." : "");
  document.title = `${named(index)}: ${state.name}`;
  const bar = of("bar");
  if (bar.childElementCount !== state.shown.length)
    bar.replaceChildren(...state.shown.map(() => document.createElement("i")));
  const skipped = new Set(state.skipped);
  for (const [k, part] of [...bar.children].entries())
    part.className = (state.points[state.shown[k]] ? "picked" : skipped.has(state.shown[k])
      ? "skipped" : "") + (k === index ? " here" : "");
  of("back").disabled = ended || index === 0;
  of("next").disabled = ended || index === state.shown.length - 1;
  for (const id of ["skip", "undo", "finish"]) of(id).disabled = ended;
}

function draw() {
  const [columns, rows] = state.size, place = of("place").getBoundingClientRect();
  scale = Math.min(place.width / columns, place.height / rows);
  const wide = Math.floor(columns * scale), high = Math.floor(rows * scale);
  const dense = window.devicePixelRatio || 1;
  frame.width = wide * dense; frame.height = high * dense;
  frame.style.width = `${wide}px`; frame.style.height = `${high}px`;
  frame.style.left = `${Math.floor((place.width - wide) / 2)}px`;
  const pen = frame.getContext("2d");
  pen.scale(dense, dense);
  if (image && image.complete && image.naturalWidth) pen.drawImage(image, 0, 0, wide, high);
  frame.dataset.shown = image && image.complete ? state.shown[index] : "";
  const point = state.points[state.shown[index]];
  if (!point) return;
  const x = (point[0] + 0.5) * scale, y = (point[1] + 0.5) * scale;
  pen.strokeStyle = "#ff9e40"; pen.lineWidth = 1.5;
  pen.beginPath(); pen.arc(x, y, 9, 0, 7);
  for (const [a, b] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    pen.moveTo(x + 4 * a, y + 4 * b); pen.lineTo(x + 15 * a, y + 15 * b);
  }
  pen.stroke();
}

function magnify(event) {
  const box = frame.getBoundingClientRect();
  const x = (event.clientX - box.left) / scale, y = (event.clientY - box.top) / scale;
  const pen = loupe.getContext("2d"), half = loupe.width / 2;
  loupe.style.visibility = "visible";
  // Not over the place that is being looked at.
  loupe.style[x > state.size[0] / 2 ? "left" : "right"] = "8px";
  loupe.style[x > state.size[0] / 2 ? "right" : "left"] = "auto";
  pen.fillStyle = "#000"; pen.fillRect(0, 0, loupe.width, loupe.height);
  if (image && image.complete && image.naturalWidth) {
    pen.imageSmoothingEnabled = false;
    pen.drawImage(image, half - ZOOM * x, half - ZOOM * y, ZOOM * state.size[0],
      ZOOM * state.size[1]);
  }
  pen.strokeStyle = "#ff9e40";
  pen.beginPath();
  pen.moveTo(half, 0); pen.lineTo(half, half - 6); pen.moveTo(half, half + 6);
  pen.lineTo(half, 2 * half); pen.moveTo(0, half); pen.lineTo(half - 6, half);
  pen.moveTo(half + 6, half); pen.lineTo(2 * half, half);
  pen.stroke();
}

// One request after the other: a fast hand must not overtake itself.
function ask(what, body) {
  const asked = busy.then(async () => {
    const answer = await fetch(what, { method: "POST", body: JSON.stringify(body || {}),
      headers: { "Content-Type": "application/json" } });
    // Whoever has another run's address is refused without a word of why.
    if (answer.status === 404)
      throw new Error("this page is of an earlier run: open the address that jaxcal printed last");
    const told = await answer.json();
    if (!answer.ok) throw new Error(told.error || answer.statusText);
    trouble("");
    state = told;
    return told;
  });
  busy = asked.catch((error) => {
    trouble(error instanceof TypeError ? "jaxcal does not answer: is it still running?"
      : error.message);
    if (state) tell();
  });
  return asked;
}

function after(from) {
  // The next frame that is still open, then the next frame.
  const open = (k) => !state.points[state.shown[k]] && !state.skipped.includes(state.shown[k]);
  for (let k = from + 1; k < state.shown.length; k++) if (open(k)) return k;
  return Math.min(from + 1, state.shown.length - 1);
}

const quiet = () => {};
function pick(u, v, stay) {
  const [columns, rows] = state.size, here = index;
  u = Math.round(100 * Math.max(-0.5, Math.min(u, columns - 0.5))) / 100;
  v = Math.round(100 * Math.max(-0.5, Math.min(v, rows - 0.5))) / 100;
  ask("pick", { frame: state.shown[here], u, v }).then(() => show(stay ? here : after(here)), quiet);
}
function skip() {
  const here = index;
  ask("skip", { frame: state.shown[here] }).then(() => show(after(here)), quiet);
}
function undo() {
  ask("undo").then((told) => {
    const back = told.undone === null ? index : state.shown.indexOf(told.undone);
    show(back < 0 ? index : back);
  }, quiet);
}
function finish() { ask("finish").then(() => { ended = true; tell(); }, quiet); }
function nudge(du, dv) {
  const point = state.points[state.shown[index]];
  if (point) pick(point[0] + du, point[1] + dv, true);
}

frame.addEventListener("click", (event) => {
  if (ended) return;
  const box = frame.getBoundingClientRect();
  pick((event.clientX - box.left) / scale - 0.5, (event.clientY - box.top) / scale - 0.5, false);
});
frame.addEventListener("mousemove", magnify);
frame.addEventListener("mouseleave", () => { loupe.style.visibility = "hidden"; });
window.addEventListener("resize", draw);
window.addEventListener("keydown", (event) => {
  if (ended || !state || event.altKey || event.metaKey) return;
  const undone = event.key === "u" || (event.ctrlKey && event.key === "z");
  if (event.ctrlKey && !undone) return;
  const moves = { ArrowLeft: [-NUDGE, 0], ArrowRight: [NUDGE, 0], ArrowUp: [0, -NUDGE],
    ArrowDown: [0, NUDGE] };
  if (event.shiftKey && moves[event.key]) nudge(...moves[event.key]);
  else if (undone) undo();
  else if (["ArrowRight", "n", " "].includes(event.key)) show(index + 1);
  else if (["ArrowLeft", "b", "p"].includes(event.key)) show(index - 1);
  else if (event.key === "s") skip();
  else if (event.key === "f") finish();
  else return;
  event.preventDefault();
});
for (const [id, act] of [["back", () => show(index - 1)], ["next", () => show(index + 1)],
  ["skip", skip], ["undo", undo], ["finish", finish]])
  of(id).addEventListener("click", (event) => { act(); event.currentTarget.blur(); });

fetch("state").then((answer) => answer.json()).then((told) => {
  state = told;
  show(told.next === null ? 0 : told.shown.indexOf(told.next));
}).catch(() => trouble("jaxcal does not answer"));
