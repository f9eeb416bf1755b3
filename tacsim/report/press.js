"use strict";
// The surface of a pressed gel in 3-D. Lengths are in mm.
const data = JSON.parse(document.getElementById("data").textContent);
const canvas = document.getElementById("surface");
const deepest = Math.max(...data.depths, 1e-6), span = Math.max(data.width, data.height);
const factor = Math.max(1, Math.round((0.2 * span) / deepest)); // so that the deepest point is seen
let turn = -0.5, tilt = 0.65;
document.getElementById("factor").textContent = factor;
function draw() {
  const ratio = devicePixelRatio || 1, pen = canvas.getContext("2d");
  canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.clientHeight * ratio);
  const scale = (0.95 * canvas.width) / Math.hypot(data.width, data.height), [c, s, k, t] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
  const points = data.depths.map((depth, at) => {
    const x = data.width * ((at % data.columns) / (data.columns - 1) - 0.5), y = -data.height * (Math.floor(at / data.columns) / (data.rows - 1) - 0.5), z = factor * depth - 0.06 * span;
    const away = c * y - s * x;
    return [canvas.width / 2 + scale * (c * x + s * y), canvas.height / 2 - scale * (k * z + t * away), k * away - t * z];
  });
  const faces = [];
  for (let row = 0; row + 1 < data.rows; row++) for (let column = 0; column + 1 < data.columns; column++) {
    const at = row * data.columns + column, corners = [at, at + 1, at + data.columns + 1, at + data.columns];
    faces.push([points[at][2] + points[at + data.columns + 1][2], corners]);
  }
  pen.lineWidth = 0.8 * ratio;
  for (const [, corners] of faces.sort((a, b) => b[0] - a[0])) {
    const slope = (factor * (data.depths[corners[1]] - data.depths[corners[0]] + data.depths[corners[0]] - data.depths[corners[3]])) / (data.width / data.columns);
    pen.beginPath(); corners.forEach((corner, k) => pen[k ? "lineTo" : "moveTo"](points[corner][0], points[corner][1])); pen.closePath();
    pen.fillStyle = pen.strokeStyle = shade(data.colours[corners[0]], Math.max(0.55, Math.min(1.3, 1 + 0.18 * slope)));
    pen.fill(); pen.stroke();
  }
}
function shade(colour, light) { return `rgb(${[1, 3, 5].map((k) => Math.min(255, Math.round(parseInt(colour.slice(k, k + 2), 16) * light))).join()})`; }
canvas.onpointermove = (event) => {
  if (!event.buttons) return;
  turn += event.movementX / 120;
  tilt = Math.max(0.05, Math.min(1.5, tilt + event.movementY / 120));
  draw();
};
addEventListener("resize", draw);
draw();
