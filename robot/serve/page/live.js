"use strict";
// The token stands in the address after '#', which a browser sends to no server; it does not stay in the address.
const token = new URLSearchParams(location.hash.slice(1)).get("token") || sessionStorage.getItem("token") || "";
if (token) sessionStorage.setItem("token", token);
if (location.hash) history.replaceState(null, "", location.pathname);

const $ = (id) => document.getElementById(id);
const BEAT = 100; // between two signs of life, which carry the jog [ms]
const DEAD_ZONE = 0.15; // of a stick
const CELL = 24; // of an arrow of the flow [px]
const FLOW_SCALE = 8; // drawn length over real length of the flow
const COLOURS = ["#6ea8fe", "#f0a65a", "#7bd88f", "#d78bea"];
const KEYS = { ArrowRight: [0, 1], ArrowLeft: [0, -1], ArrowDown: [1, 1], ArrowUp: [1, -1], w: [2, 1], s: [2, -1], e: [5, 1], q: [5, -1] };
const PAD = [["← x", 0, -1], ["x →", 0, 1], ["↑ y", 1, -1], ["y ↓", 1, 1], ["z out", 2, 1], ["z in", 2, -1], ["⟲ z", 5, -1], ["z ⟳", 5, 1]];
const LAMPS = { none: "no reference", fresh: "fresh", stale: "stale: the light has drifted", touched: "shows a contact" };
let socket = null, state = {}, error = "", errorWords = "";
const held = new Map(); // keys and buttons held: name -> [axis, sign]

// -- words: an error stays until the server says something new -------------------------------------------------------
function showWords() {
  if (error && state.words !== errorWords) error = "";
  const shown = error || state.words || "";
  const hint = token ? "" : "This page has no token: it can look and STOP. ";
  $("words").textContent = hint + shown;
  $("words").classList.toggle("error", Boolean(error) || state.phase === "failed");
}
function showError(words) { error = words; errorWords = state.words; showWords(); }

async function post(path, body) {
  try {
    const answer = await fetch(path, { method: "POST", headers: { Authorization: "Bearer " + token }, body: JSON.stringify(body || {}) });
    if (answer.ok) { error = ""; showWords(); return true; }
    showError((await answer.json()).error || answer.statusText);
  } catch (failure) { showError("the server does not answer: " + failure.message); }
  return false;
}

// -- STOP: by a request and by the stream, whichever is faster; needs no token ---------------------------------------
function stop() {
  held.clear();
  if (socket && socket.readyState === WebSocket.OPEN) socket.send('{"stop": true}');
  fetch("/stop", { method: "POST", keepalive: true }).catch((failure) => showError("STOP did not reach the server: " + failure.message));
}
$("stop").addEventListener("pointerdown", stop);
$("stop").addEventListener("click", (event) => { if (event.detail === 0) stop(); }); // by keyboard

// -- episode -------------------------------------------------------------------------------------------------------
const isRunning = () => state.phase === "running";
function start(mode) {
  const steps = parseInt($("steps").value);
  post("/start", { mode, steps: steps > 0 ? steps : null, seed: parseInt($("seed").value) || 0, record: $("record").checked });
}
$("start").onclick = () => (isRunning() ? post("/mode", { mode: "policy" }) : start($("by").value));
$("pause").onclick = () => post("/mode", { mode: "paused" });
$("step").onclick = () => (isRunning() ? post("/mode", { mode: "step" }) : start("step"));
$("end").onclick = () => post("/end");
$("drive").onclick = () => (isRunning() ? post("/mode", { mode: "teleoperation" }) : post("/drive"));
$("reference").onclick = () => post("/reference");
$("recover").onclick = () => post("/recover");
$("keep").onclick = () => post("/keep", { note: $("note").value }).then((done) => { if (done) $("note").value = ""; });
$("discard").onclick = () => post("/discard");
for (const button of $("question").querySelectorAll("button")) button.onclick = () => post("/answer", { yes: button.dataset.yes === "true" });

// -- moving by hand ------------------------------------------------------------------------------------------------
const keyOf = (event) => (event.key.length === 1 ? event.key.toLowerCase() : event.key);
function hold(name, motion) { held.set(name, motion); beat(); }
function release(name) { if (held.delete(name)) beat(); }
function releaseAll() { held.clear(); beat(); }
addEventListener("keydown", (event) => {
  if (event.key === "Escape") { stop(); return; }
  if (event.target.matches("input:not([type=range]):not([type=checkbox])")) return; // somebody writes
  if (event.code === "Space") { event.preventDefault(); if (!event.repeat) stop(); return; }
  if (state.mode !== "teleoperation" || !KEYS[keyOf(event)] || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  if (!event.repeat) hold(keyOf(event), KEYS[keyOf(event)]);
});
addEventListener("keyup", (event) => release(keyOf(event)));
addEventListener("blur", releaseAll);
document.addEventListener("visibilitychange", releaseAll);
for (const [label, axis, sign] of PAD) {
  const button = document.createElement("button");
  button.textContent = label;
  button.addEventListener("pointerdown", (event) => { button.setPointerCapture(event.pointerId); hold(label, [axis, sign]); });
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(kind, () => release(label));
  button.addEventListener("contextmenu", (event) => event.preventDefault());
  $("pad").append(button);
}
function readGamepads(speed, jog) {
  for (const pad of navigator.getGamepads ? navigator.getGamepads() : []) {
    if (!pad) continue;
    if (pad.buttons[1] && pad.buttons[1].pressed) stop();
    const stick = (number) => (Math.abs(pad.axes[number] || 0) > DEAD_ZONE ? pad.axes[number] : 0);
    jog[0] += stick(0) * speed; jog[1] += stick(1) * speed; jog[2] -= stick(3) * speed; jog[5] += stick(2) * speed;
  }
}
function beat() {
  const speed = parseFloat($("speed").value), jog = [0, 0, 0, 0, 0, 0];
  for (const [axis, sign] of held.values()) jog[axis] += sign * speed;
  readGamepads(speed, jog);
  if (!socket || socket.readyState !== WebSocket.OPEN) return;
  const message = { token };
  if (state.mode === "teleoperation" && $("arm").value) {
    message.arm = $("arm").value; message.jog = jog.map((value) => Math.max(-1, Math.min(1, value)));
  }
  socket.send(JSON.stringify(message));
}
setInterval(beat, BEAT);

// -- stream --------------------------------------------------------------------------------------------------------
function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (event) => receive(event.data);
  socket.onclose = () => {
    held.clear();
    $("phase").textContent = "server lost"; $("phase").className = "pill lost";
    setTimeout(connect, 1000);
  };
}
function receive(buffer) {
  const size = new DataView(buffer).getUint32(0);
  state = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
  let offset = 4 + size;
  for (const [name, length] of Object.entries(state.pictures)) {
    showPicture(name, new Uint8Array(buffer, offset, length));
    offset += length;
  }
  draw();
}
function cardOf(sensor) {
  let card = document.querySelector(`[data-sensor="${CSS.escape(sensor)}"]`);
  if (card) return card;
  card = document.createElement("div");
  card.className = "card sensor"; card.dataset.sensor = sensor;
  card.innerHTML = '<h2></h2><div class="pictures"></div><table></table>';
  card.querySelector("h2").textContent = sensor;
  $("sensors").append(card);
  return card;
}
function figureOf(sensor, kind, caption, content) {
  const card = cardOf(sensor);
  let figure = card.querySelector(`[data-kind="${kind}"]`);
  if (figure) return figure;
  figure = document.createElement("figure");
  figure.dataset.kind = kind;
  figure.innerHTML = `<div class="frame">${content}</div><figcaption></figcaption>`;
  figure.querySelector("figcaption").textContent = caption;
  for (const image of figure.querySelectorAll("img")) image.alt = `${kind} of sensor ${sensor}`;
  card.querySelector(".pictures").append(figure);
  return figure;
}
function showPicture(name, bytes) {
  const [sensor, kind] = name.split("/");
  const figure = kind === "height"
    ? figureOf(sensor, kind, "height", '<img><canvas></canvas>') : figureOf(sensor, kind, "picture", "<img>");
  const image = figure.querySelector("img"), old = image.src;
  image.src = URL.createObjectURL(new Blob([bytes], { type: "image/jpeg" }));
  if (old.startsWith("blob:")) URL.revokeObjectURL(old);
}

// -- what a view says ----------------------------------------------------------------------------------------------
function number(value, digits) {
  if (value === null || value === undefined) return "–";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? (0).toFixed(digits) : text; // no "-0.00"
}
const isGiven = (value) => value !== null && value !== undefined;
function rows(table, pairs) {
  table.replaceChildren(...pairs.map(([key, ...values]) => {
    const row = document.createElement("tr");
    for (const text of [key, ...values]) {
      const cell = document.createElement("td");
      cell.append(text);
      row.append(cell);
    }
    return row;
  }));
}
function lampOf(kind, words) {
  const line = document.createElement("span"), lamp = document.createElement("span");
  lamp.className = "lamp " + kind;
  line.append(lamp, words);
  return line;
}
function draw() {
  const now = state;
  $("rig").textContent = now.rig;
  $("task").textContent = now.task ? `${now.task}, policy ${now.policy}` : `policy ${now.policy}`;
  $("phase").textContent = isRunning() && now.mode ? { policy: "running", step: "single step", paused: "paused", teleoperation: "by hand" }[now.mode] : now.phase;
  $("phase").className = "pill " + now.phase;
  showWords();
  $("question").hidden = !now.question;
  $("question").querySelector("p").textContent = now.question || "";
  drawControls(now);
  drawStep(now.step);
  for (const [name, touch] of Object.entries(now.sensors || {})) drawSensor(name, touch);
  drawArms(now);
  $("lamps").replaceChildren(...Object.entries(now.lamps || {}).map(([name, kind]) => {
    const line = document.createElement("div");
    line.append(lampOf(kind, `${name}: ${LAMPS[kind]}`));
    return line;
  }));
  drawChart(now);
}
function drawControls(now) {
  const running = isRunning(), rests = now.phase === "watching" || now.phase === "failed";
  const mayContinue = running && now.is_episode && now.mode !== "policy";
  $("start").textContent = mayContinue ? "Continue" : "Start";
  $("start").disabled = !token || !(mayContinue || (rests && !now.pending));
  $("pause").disabled = !token || !running || !now.is_episode || now.mode === "paused";
  $("step").disabled = !token || !((running && now.is_episode) || (rests && !now.pending));
  $("end").disabled = !token || !running;
  $("drive").disabled = !token || !(rests || (running && now.mode !== "teleoperation"));
  $("reference").disabled = $("recover").disabled = !token || !rests;
  $("keep").disabled = $("discard").disabled = !token;
  $("hand").hidden = now.mode !== "teleoperation";
  $("pending").hidden = !now.pending;
  $("recording").textContent = now.pending || "";
  $("report").hidden = !now.report;
  $("report").textContent = `Report of ${now.report}`;
  $("report-state").textContent = now.report_state || "";
}
function drawStep(step) {
  const parts = step ? [`step ${step.index}`] : [];
  if (step && isGiven(step.reward)) parts.push(`reward ${number(step.reward, 3)}`);
  if (step && isGiven(step.distance)) parts.push(`distance to the goal ${number(1e3 * step.distance, 3)} mm`);
  $("progress").textContent = parts.join(" · ");
}
function drawSensor(name, touch) {
  const pairs = [];
  if (isGiven(touch.signal)) pairs.push(["contact signal", number(touch.signal, 4)]);
  if (isGiven(touch.depth)) pairs.push(["depth", number(1e3 * touch.depth, 3) + " mm"]);
  if (isGiven(touch.contact)) pairs.push(["contact area", number(1e2 * touch.contact, 1) + " %"]);
  if (touch.flow) pairs.push(["longest flow", number(1e3 * touch.flow.longest, 3) + " mm"]);
  if (isGiven(touch.slip)) pairs.push(["slip", String(touch.slip)]);
  if (isGiven(touch.age)) pairs.push(["picture age", number(1e3 * touch.age, 0) + " ms"]);
  const card = cardOf(name);
  rows(card.querySelector("table"), pairs);
  const height = card.querySelector('[data-kind="height"]');
  if (touch.flow) drawFlow((height || figureOf(name, "flow", "flow", "<canvas></canvas>")).querySelector("canvas"), touch.flow);
  if (height) height.querySelector("figcaption").textContent = "height, 0 to 1 mm" + (touch.flow ? `; flow × ${FLOW_SCALE}` : "");
}
function drawArms(now) {
  const arms = Object.entries(now.arm_states || {});
  if ($("arm").options.length !== arms.length) $("arm").replaceChildren(...arms.map(([name]) => new Option(name)));
  const lines = arms.flatMap(([name, own]) => {
    const arm = (now.arms || {})[name], found = [[name, lampOf(own.lamp, own.words.replace(`arm '${name}' `, ""))]];
    if (!arm) return found;
    found.push(["position", arm.position.map((value) => number(1e3 * value, 2)).join(", ") + " mm"]);
    found.push(["force", arm.force.map((value) => number(value, 2)).join(", ") + " N"]);
    if (arm.gripper) found.push(["gripper", String(arm.gripper)]);
    return found;
  });
  const table = $("arms").querySelector("table") || $("arms").appendChild(document.createElement("table"));
  rows(table, lines);
}
$("arm").onchange = () => $("arm").blur(); // so that the arrow keys move the arm

// -- flow and force ------------------------------------------------------------------------------------------------
function drawFlow(canvas, flow) {
  const [high, wide] = flow.shape, size = FLOW_SCALE * CELL;
  canvas.width = wide * CELL; canvas.height = high * CELL;
  const pen = canvas.getContext("2d");
  pen.strokeStyle = pen.fillStyle = "white"; pen.lineWidth = 2;
  for (let row = 0; row < high; row++) for (let column = 0; column < wide; column++) {
    const k = 2 * (row * wide + column), x = CELL * (column + 0.5), y = CELL * (row + 0.5);
    pen.beginPath(); pen.arc(x, y, 2, 0, 7); pen.fill();
    pen.beginPath(); pen.moveTo(x, y); pen.lineTo(x + size * flow.arrows[k], y + size * flow.arrows[k + 1]); pen.stroke();
  }
}
let forces = [], viewTimes = [], lastTime = null;
function drawChart(now) {
  const names = Object.keys(now.arms || {});
  if (names.length && now.time !== lastTime) {
    lastTime = now.time;
    forces = [...forces.slice(-299), names.map((name) => Math.hypot(...now.arms[name].force))];
    viewTimes = [...viewTimes.slice(-49), performance.now()];
  }
  const canvas = $("chart"), pen = canvas.getContext("2d"), { width, height } = canvas;
  pen.clearRect(0, 0, width, height);
  const highest = Math.max(1, ...forces.flat()), last = Math.max(forces.length - 1, 60);
  names.forEach((name, which) => {
    pen.strokeStyle = COLOURS[which % COLOURS.length]; pen.lineWidth = 2.5; pen.beginPath();
    forces.forEach((each, k) => { if (isGiven(each[which])) pen.lineTo((k / last) * width, height - 4 - (each[which] / highest) * (height - 12)); });
    pen.stroke();
  });
  $("legend").replaceChildren(...names.map((name, which) => {
    const entry = document.createElement("span");
    entry.textContent = `${name} ${number(forces.length ? forces[forces.length - 1][which] : null, 2)} N   `;
    entry.style.color = COLOURS[which % COLOURS.length];
    return entry;
  }), `scale: 0 to ${number(highest, 1)} N`);
  drawTiming(now);
}
function drawTiming(now) {
  const span = viewTimes.length > 1 ? (viewTimes[viewTimes.length - 1] - viewTimes[0]) / (viewTimes.length - 1) : 0;
  const pairs = [["views", (span ? number(1e3 / span, 1) : "–") + " a second"]], step = now.step;
  if (step) pairs.push(["control step", number(1e3 * step.seconds, 0) + " ms"]);
  const timing = step ? step.timing : {};
  if (isGiven(timing.period_median)) {
    pairs.push(["period, median / p99 / max", [timing.period_median, timing.period_p99, timing.period_max].map((value) => number(1e3 * value, 0)).join(" / ") + " ms"]);
    pairs.push(["periods late", number(timing.periods_late, 0)]);
  }
  for (const [key, value] of Object.entries(timing)) {
    if (key.startsWith("limits_hit_") && value > 0) pairs.push([`targets limited, ${key.slice(11)}`, number(value, 0)]);
  }
  rows($("timing"), pairs);
}
connect();
