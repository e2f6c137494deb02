"use strict";
// Copying, and the two views in space, which turn when they are dragged. No request to anywhere.
for (const button of document.querySelectorAll("button[data-copy]")) {
  button.addEventListener("click", async () => {
    const source = document.getElementById(button.dataset.copy);
    let done = false;
    try {
      await navigator.clipboard.writeText(source.textContent);
      done = true;
    } catch {
      const range = document.createRange();
      range.selectNodeContents(source);
      getSelection().removeAllRanges();
      getSelection().addRange(range);
      done = document.execCommand("copy");
    }
    button.textContent = done ? "copied" : "press Ctrl-C";
    setTimeout(() => { button.textContent = "copy"; }, 1500);
  });
}

const NS = "http://www.w3.org/2000/svg";

function scene(svg) {
  const data = JSON.parse(document.getElementById(svg.dataset.scene).textContent);
  const [width, height] = [380, 300];
  let [turn, tilt] = [0.6, 0.45];

  function project(point) {
    const p = point.map((value, k) => value - data.centre[k]);
    const x = Math.cos(turn) * p[0] + Math.sin(turn) * p[1];
    const y = -Math.sin(turn) * p[0] + Math.cos(turn) * p[1];
    const up = Math.cos(tilt) * p[2] - Math.sin(tilt) * y;
    const scale = 0.48 * Math.min(width, height) / data.radius;
    return [width / 2 + scale * x, height / 2 - scale * up];
  }

  function add(name, attributes, words) {
    const element = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (words !== undefined) element.textContent = words;
    svg.append(element);
    return element;
  }

  function draw() {
    svg.replaceChildren();
    for (const line of data.lines) {
      const path = line.points.map(project).map((p) => p.map((v) => v.toFixed(1)).join(" "));
      add("path", {
        d: "M" + path.join("L"), fill: line.fill ?? "none", stroke: line.colour,
        "stroke-width": line.width ?? 0.8, "fill-opacity": 0.03, "stroke-opacity": line.fill ? 0.45 : 1,
      });
    }
    for (const dot of data.dots) {
      const [cx, cy] = project(dot.at);
      const element = add("circle", { cx: cx.toFixed(1), cy: cy.toFixed(1), r: dot.r, fill: dot.colour });
      if (dot.title) {
        const title = document.createElementNS(NS, "title");
        title.textContent = dot.title;
        element.append(title);
      }
    }
    // The axes' directions in a corner, and a bar of a round length.
    const origin = project(data.centre);
    const size = 0.48 * Math.min(width, height) / data.radius;
    for (const [k, name] of ["x", "y", "z"].entries()) {
      const end = data.centre.map((value, j) => value + (j === k ? 1 : 0));
      const [a, b] = project(end).map((value, j) => (value - origin[j]) / size * 22);
      add("path", { d: `M40 262l${a.toFixed(1)} ${b.toFixed(1)}`, stroke: "var(--text)", "stroke-width": 1 });
      if (Math.hypot(a, b) > 7) {
        add("text", { x: (40 + 1.4 * a).toFixed(1), y: (265 + 1.4 * b).toFixed(1), "text-anchor": "middle", class: "tick" }, name);
      }
    }
    const bar = data.bar * size;
    add("path", { d: `M${364 - bar} 282h${bar}`, stroke: "var(--text)", "stroke-width": 2 });
    add("text", { x: 364, y: 276, "text-anchor": "end", class: "tick" }, data.bar + " mm");
  }

  let held = null;
  svg.addEventListener("pointerdown", (event) => { held = [event.clientX, event.clientY]; svg.setPointerCapture(event.pointerId); });
  svg.addEventListener("pointermove", (event) => {
    if (!held) return;
    turn += (event.clientX - held[0]) * 0.01;
    tilt = Math.max(-1.5, Math.min(1.5, tilt + (event.clientY - held[1]) * 0.01));
    held = [event.clientX, event.clientY];
    draw();
  });
  svg.addEventListener("pointerup", () => { held = null; });
  svg.addEventListener("pointercancel", () => { held = null; });
  svg.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
    if (!step) return;
    event.preventDefault();
    turn += step[0];
    tilt = Math.max(-1.5, Math.min(1.5, tilt + step[1]));
    draw();
  });
  draw();
}

for (const svg of document.querySelectorAll("svg[data-scene]")) scene(svg);
