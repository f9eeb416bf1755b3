"use strict";
// The player of an episode's page: body and gels, pictures, curves with a cursor. Lengths are in mm.
const data = JSON.parse(document.getElementById("episode").textContent);
const element = (id) => document.getElementById(id);
const COLOURS = ["#2a6db5", "#cf5b17", "#7a4fb0", "#b0891f", "#1b8f8f", "#a8325e"];
const CLAY = [[206, 98, 56], [240, 184, 124]], GEL = [150, 196, 220], BACK = [70, 78, 88];
const FRAME_MS = 100, MAX_TILT = 1.5;
const SPACE_VIEW = [-0.5, 0.28], SECTION_VIEW = [0, 0.22]; // turn, tilt [rad]
let now = 0, timer = null, section = false, [turn, tilt] = SPACE_VIEW, isFresh = true;

const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
const bodies = data.moments.map((moment) => {
  if (!moment.body) return null;
  return Float32Array.from(new Uint8Array(bytes(moment.body)), (value, k) => data.space.lower[k % 3] + (value / 255) * data.space.size);
});
const gels = data.moments.map((moment) => Object.entries(moment.gels).map(([name, gel]) => gelPoints(data.gels[name], gel)));
const hasScene = bodies.some((body) => body) || gels.some((each) => each.length);

// Points of a gel in world: its surface (grid x grid), then the same of its back.
function gelPoints(size, gel) {
  const height = new Int16Array(bytes(gel.height)), n = data.grid, front = [], back = [];
  for (let row = 0; row < n; row++) for (let column = 0; column < n; column++) {
    const x = size[0] * (column / (n - 1) - 0.5), y = size[1] * (row / (n - 1) - 0.5);
    front.push(transform(gel.pose, x, y, -height[row * n + column] / 1000));
    back.push(transform(gel.pose, x, y, -size[2]));
  }
  const lines = Math.abs(gel.pose[1][1]) >= Math.abs(gel.pose[1][0]) ? (line, k) => line * n + k : (line, k) => k * n + line;
  const rows = [...Array(n).keys()].map((line) => [...Array(n).keys()].map((k) => lines(line, k)));
  return { front, back, height, rows, pose: gel.pose }; // rows: numbers of the points of each line along x in world
}
function transform(pose, x, y, z) { return pose.map((row) => row[0] * x + row[1] * y + row[2] * z + row[3]); }

// -- the scene: everything is drawn from far to near ---------------------------------------------------------------
const extent = (() => { // middle and half diagonal of all that is ever seen
  const low = [1e9, 1e9, 1e9], high = [-1e9, -1e9, -1e9];
  const add = (x, y, z) => [x, y, z].forEach((value, axis) => { low[axis] = Math.min(low[axis], value); high[axis] = Math.max(high[axis], value); });
  bodies.forEach((body) => { for (let k = 0; body && k < body.length; k += 3) add(body[k], body[k + 1], body[k + 2]); });
  gels.forEach((each) => each.forEach((gel) => [...gel.front, ...gel.back].forEach((point) => add(...point))));
  return { middle: low.map((value, axis) => (value + high[axis]) / 2), size: Math.hypot(...low.map((value, axis) => high[axis] - value)) || 1 };
})();
let sprites = [], spriteRadius = 0; // of a particle of each layer, at the size in which they are drawn
function makeSprites(radius) {
  if (radius === spriteRadius) return;
  spriteRadius = radius;
  sprites = CLAY.map((colour) => {
    const canvas = document.createElement("canvas"), tone = (factor) => `rgb(${colour.map((value) => Math.min(255, Math.round(value * factor))).join()})`;
    canvas.width = canvas.height = Math.ceil(2 * radius);
    const pen = canvas.getContext("2d"), shade = pen.createRadialGradient(0.75 * radius, 0.65 * radius, 0.1 * radius, radius, radius, radius);
    shade.addColorStop(0, tone(1.1)); shade.addColorStop(0.5, tone(1)); shade.addColorStop(1, tone(0.8));
    pen.fillStyle = shade; pen.beginPath(); pen.arc(radius, radius, radius, 0, 7); pen.fill();
    return canvas;
  });
}
function drawScene() {
  const { canvas, pen, ratio } = clearCanvas(element("scene"));
  const scale = (1.15 * Math.min(canvas.width, canvas.height)) / extent.size, cx = canvas.width / 2, cy = canvas.height / 2;
  const [c, s, k, t] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)], [mx, my, mz] = extent.middle;
  const direct = ([x, y, z]) => [c * x + s * y, -(k * z + t * (c * y - s * x)), k * (c * y - s * x) - t * z]; // right, down, away
  const see = ([x, y, z]) => { const [right, down, away] = direct([x - mx, y - my, z - mz]); return [cx + scale * right, cy + scale * down, away]; };
  const fill = (corners, colour) => {
    pen.beginPath(); corners.forEach(([u, v], at) => pen[at ? "lineTo" : "moveTo"](u, v)); pen.closePath();
    pen.fillStyle = pen.strokeStyle = colour; pen.lineWidth = 0.8 * ratio; pen.fill(); pen.stroke();
  };
  const parts = gels[now].map((gel) => [gel.front[0][2], () => drawGel(gel, see, direct, fill, bodies[now] ? mean(bodies[now], 1) : my)]);
  if (bodies[now]) parts.push([mean(bodies[now], 2), () => drawBody(bodies[now], see, pen, 0.9 * data.spacing * scale)]);
  parts.sort((a, b) => (a[0] - b[0]) * (tilt < 0 ? -1 : 1)).forEach((part) => part[1]()); // stacked along z: the hidden ones first
}
function mean(body, axis) { let sum = 0; for (let k = axis; k < body.length; k += 3) sum += body[k]; return (3 * sum) / body.length; }
function drawBody(body, see, pen, radius) {
  const seen = [], wanted = section ? 2 : 1;
  makeSprites(radius);
  for (let k = 0; k < Math.min(data.visible.length, body.length / 3); k++) if (data.visible[k] & wanted) seen.push([...see([body[3 * k], body[3 * k + 1], body[3 * k + 2]]), data.layers[k]]);
  seen.sort((a, b) => b[2] - a[2]).forEach(([u, v, , layer]) => pen.drawImage(sprites[layer], Math.round(u - radius), Math.round(v - radius)));
}
function drawGel(gel, see, direct, fill, middle) { // middle: y of the section
  const n = data.grid, all = [...Array(n).keys()], front = gel.front.map(see), back = gel.back.map(see);
  const isSeen = (x, y, z) => direct(gel.pose.map((row) => row[0] * x + row[1] * y + row[2] * z))[2] < 0; // a face with this normal
  const offset = (row) => Math.abs(gel.front[row[0]][1] + gel.front[row[n - 1]][1] - 2 * middle);
  const cut = gel.rows.reduce((best, row) => (offset(row) < offset(best) ? row : best)), limit = Math.min(gel.front[cut[0]][1], gel.front[cut[n - 1]][1]) - 1e-6;
  const keep = (numbers) => (section ? numbers.filter((k) => gel.front[k][1] >= limit) : numbers);
  const tint = (colour, light) => `rgb(${colour.map((value) => Math.min(255, Math.round(value * light))).join()})`;
  const side = (numbers, light) => { if (numbers.length > 1) fill([...numbers.map((k) => front[k]), ...numbers.map((k) => back[k]).reverse()], tint(GEL, light)); };
  const edges = [all, all.map((k) => n * (n - 1) + k), all.map((k) => n * k), all.map((k) => n * k + n - 1)].map(keep); // y low, y high, x low, x high
  if (isSeen(0, 0, 1)) for (let row = 0; row + 1 < n; row++) for (let column = 0; column + 1 < n; column++) {
    const at = row * n + column, numbers = keep([at, at + 1, at + n + 1, at + n]);
    const slope = (gel.height[at + 1] - gel.height[at] + gel.height[at + n] - gel.height[at]) / 400;
    if (numbers.length === 4) fill(numbers.map((k) => front[k]), tint(GEL, Math.max(0.6, Math.min(1.2, 1 + slope))));
  }
  const corners = [0, n - 1, n * n - 1, n * n - n].map((k) => back[k]);
  if (isSeen(0, 0, -1) && !section) fill(corners, tint(BACK, 1));
  if (isSeen(0, 0, -1) && section) for (let row = 0; row + 1 < n; row++) { // in strips, so that a section can end anywhere
    const numbers = [keep(gel.rows[row]), keep(gel.rows[row + 1])];
    if (numbers.every((each) => each.length > 1)) fill([numbers[0][0], numbers[0].at(-1), numbers[1].at(-1), numbers[1][0]].map((k) => back[k]), tint(BACK, 1));
  }
  [[0, -1], [0, 1], [-1, 0], [1, 0]].forEach(([x, y], k) => { if (isSeen(x, y, 0)) side(edges[k], x ? 0.8 : 0.88); });
  if (section) side(cut, 1.05);
}
function clearCanvas(canvas) {
  const ratio = devicePixelRatio || 1;
  canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.clientHeight * ratio);
  return { canvas, pen: canvas.getContext("2d"), ratio };
}

// -- pictures ------------------------------------------------------------------------------------------------------
const sources = data.files.map((text) => "data:image/jpeg;base64," + text);
const images = {}, rows = {};
for (const name of new Set(data.moments.flatMap((moment) => Object.keys(moment.pictures)))) {
  const figure = document.createElement("figure"), image = document.createElement("img"), caption = document.createElement("figcaption");
  image.alt = caption.textContent = name;
  figure.append(image, caption);
  figure.style.flex = data.pictures[name][0] / data.pictures[name][1]; // pictures in a row have one height
  const sensor = name.replace(/ height$/, "");
  if (!rows[sensor]) { rows[sensor] = document.createElement("div"); element("pictures").append(rows[sensor]); }
  rows[sensor].append(figure);
  images[name] = image;
}

// -- curves --------------------------------------------------------------------------------------------------------
const charts = data.curves.map((curve) => {
  const figure = document.createElement("figure"), canvas = document.createElement("canvas"), caption = document.createElement("figcaption");
  figure.append(caption, canvas);
  element("curves").append(figure);
  const seek = (event) => { play(false); show(nearestMoment((event.offsetX / canvas.clientWidth) * (data.steps.length - 1))); };
  canvas.onpointerdown = seek;
  canvas.onpointermove = (event) => { if (event.buttons) seek(event); };
  return { curve, canvas, caption };
});
function pale(colour) { return "#" + [1, 3, 5].map((k) => Math.round((parseInt(colour.slice(k, k + 2), 16) + 2 * 255) / 3).toString(16)).join(""); }
function nearestMoment(at) { return data.moments.reduce((best, moment, k) => (Math.abs(moment.at - at) < Math.abs(data.moments[best].at - at) ? k : best), 0); }
function drawCurves() {
  const at = data.moments[now].at;
  for (const { curve, canvas, caption } of charts) {
    const { pen, ratio } = clearCanvas(canvas), names = Object.keys(curve.lines), pad = 6 * ratio;
    const known = Object.values(curve.lines).flat().filter((value) => value !== null);
    const low = Math.min(0, ...known), high = Math.max(0, ...known, low + 1e-9);
    const decimals = Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(high - low))));
    const x = (k) => pad + ((canvas.width - 2 * pad) * k) / Math.max(1, data.steps.length - 1), y = (value) => canvas.height - pad - ((canvas.height - 2 * pad) * (value - low)) / (high - low);
    const line = (colour, width, points, dash = []) => { pen.setLineDash(dash.map((each) => each * ratio)); pen.strokeStyle = colour; pen.lineWidth = width * ratio; pen.beginPath(); let open = false; for (const point of points) { if (point) pen[open ? "lineTo" : "moveTo"](...point); open = Boolean(point); } pen.stroke(); };
    line("#e3e6e9", 1, [[pad, y(0)], [canvas.width - pad, y(0)]]);
    line("#6b737c", 1, [[x(at), 0], [x(at), canvas.height]]);
    names.forEach((name, which) => {
      const colour = COLOURS[which % COLOURS.length], dash = which ? [5, 5] : [], points = curve.lines[name].map((value, k) => (value === null ? null : [x(k), y(value)]));
      line(pale(colour), 2, points, dash);
      line(colour, 2, points.slice(0, at + 1), dash);
      if (points[at]) { pen.fillStyle = colour; pen.beginPath(); pen.arc(...points[at], 3.5 * ratio, 0, 7); pen.fill(); }
    });
    caption.replaceChildren(curve.title + (curve.unit ? ` [${curve.unit}]` : ""), document.createElement("br"), ...names.map((name, which) => {
      const value = curve.lines[name][at], span = document.createElement("span");
      span.style.color = COLOURS[which % COLOURS.length];
      span.textContent = `${name} ${value === null ? "–" : value.toFixed(decimals)}   `.trimStart();
      return span;
    }));
  }
}

// -- time ----------------------------------------------------------------------------------------------------------
function show(k) {
  isFresh = false;
  now = Math.max(0, Math.min(data.moments.length - 1, k));
  const moment = data.moments[now];
  element("slider").value = now;
  element("moment").textContent = `step ${moment.step}`;
  for (const [name, image] of Object.entries(images)) {
    const file = moment.pictures[name];
    image.style.visibility = file === undefined ? "hidden" : "visible";
    if (file !== undefined) image.src = sources[file];
  }
  if (hasScene) drawScene();
  drawCurves();
}
function play(on) {
  clearInterval(timer);
  timer = on ? setInterval(() => show(now + 1 < data.moments.length ? now + 1 : 0), FRAME_MS) : null;
  element("play").textContent = on ? "Pause" : "Play";
}
function start() {
  if (isFresh || now === data.moments.length - 1) show(0);
  play(true);
}
element("slider").max = data.moments.length - 1;
element("slider").oninput = (event) => { play(false); show(Number(event.target.value)); };
element("play").onclick = () => (timer ? play(false) : start());
element("section").onchange = (event) => { section = event.target.checked; [turn, tilt] = section ? SECTION_VIEW : SPACE_VIEW; drawScene(); };
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const jump = { ArrowRight: 1, ArrowLeft: -1, PageDown: 10, PageUp: -10, Home: -1e9, End: 1e9 }[event.key];
  if (jump) { event.preventDefault(); play(false); show(now + jump); }
  if (event.key === " " && !event.target.matches("button, input[type=checkbox]")) { event.preventDefault(); element("play").click(); }
});
element("scene").onpointermove = (event) => {
  if (!event.buttons) return;
  turn += event.movementX / 120;
  tilt = Math.max(-MAX_TILT, Math.min(MAX_TILT, tilt + event.movementY / 120));
  drawScene();
};
if (!hasScene) element("player").classList.add("flat");
const force = data.curves.length ? Object.values(data.curves[0].lines) : []; // the page opens at the largest force
show(data.moments.reduce((best, moment, k) => (force.some((line) => line[moment.at] > Math.max(...force.map((each) => each[data.moments[best].at]))) ? k : best), 0));
isFresh = true;
new ResizeObserver(() => { const fresh = isFresh; show(now); isFresh = fresh; }).observe(element("player")); // also when pictures have loaded
