// SPDX-License-Identifier: Apache-2.0
// The manipulator on the first page: `derivative`, `joints` and `manipulator` are those of
// live_equations.js, which docs/live_equations.py writes from the traced program of a scene.
"use strict";

const STEP = 0.001; // of the method of Runge and Kutta, order 4 [s]
const LONGEST = 0.05; // between two pictures [s]: a tab that was hidden does not catch up
const PATH = 300; // points of E that are drawn

function advance(y, torque) {
  const slope = (at) => derivative(0.0, ...at, ...torque);
  const along = (k, h) => y.map((value, i) => value + h * k[i]);
  const k1 = slope(y);
  const k2 = slope(along(k1, STEP / 2));
  const k3 = slope(along(k2, STEP / 2));
  const k4 = slope(along(k3, STEP));
  const next = y.map((value, i) => value + (STEP / 6) * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]));
  const norm = Math.hypot(...next.slice(0, 4));
  return next.map((value, i) => (i < 4 ? value / norm : value));
}

// Why a state is not allowed; "" where it is.
function fault(y) {
  if (!y.every(Number.isFinite)) return "the motion has no finite numbers";
  const angles = joints(...y);
  const passed = manipulator.limits.find((one) => one.sign * (angles[one.joint] - one.end) < 0);
  return passed ? passed.reason : "";
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
const apply = (matrix, p) => matrix.map((row) => dot(row, p));
const columns = (m) => [0, 1, 2].map((i) => m.map((row) => row[i]));
const product = (a, b) => columns(columns(b).map((column) => apply(a, column)));

// Rotation by an angle about a unit vector (Rodrigues).
function turn(axis, angle) {
  const unit = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const turned = unit.map((e) => {
    const across = cross(axis, e);
    const twice = cross(axis, across);
    return e.map((x, i) => x + Math.sin(angle) * across[i] + (1 - Math.cos(angle)) * twice[i]);
  });
  return columns(turned);
}

// Rotations of the links by the joint angles (gamma_1..3, mu_1..3, beta_1..3).
function pose(angles) {
  const kinds = ["gamma", "mu", "beta"];
  const found = { base_link: [[1, 0, 0], [0, 1, 0], [0, 0, 1]] };
  for (const { name, parent, child, origin, axis } of manipulator.chain) {
    const [kind, leg] = name.split("_");
    const angle = angles[3 * kinds.indexOf(kind) + Number(leg) - 1];
    found[child] = product(found[parent], product(origin, turn(axis, angle)));
  }
  return found;
}

function start(place) {
  place.innerHTML = `<canvas aria-label="The manipulator, simulated; drag to look from elsewhere">
    </canvas><p class="live-status" role="status"></p>
    ${[1, 2, 3].map((k) => `<label>torque ${k} <input type="range" step="any" value="0"
      min="${-manipulator.torque_limit}" max="${manipulator.torque_limit}"><output></output></label>`)
      .join("")}
    <button>Pause</button><button>Zero torques</button><button>Reset</button>`;
  const canvas = place.querySelector("canvas");
  const status = place.querySelector("p");
  const sliders = [...place.querySelectorAll("input")];
  const outputs = [...place.querySelectorAll("output")];
  const [pause, zero, reset] = place.querySelectorAll("button");
  const radius = Math.max(...manipulator.shapes.star.flatMap((one) => one.points.map((p) => p[2])));
  let y, t, stopped, path, running = true, last = null, azimuth = 1.1, elevation = 0.75;

  function begin() {
    [y, t, stopped, path] = [manipulator.initial, 0, "", []];
  }

  function run(seconds, torque) {
    for (let n = Math.round(seconds / STEP); n > 0 && !stopped; n -= 1) {
      const next = advance(y, torque);
      stopped = fault(next);
      if (!stopped) [y, t] = [next, t + STEP]; // the last valid state stays
    }
  }

  function draw(angles) {
    const [wide, high] = [canvas.clientWidth, canvas.clientHeight];
    const sharp = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [wide * sharp, high * sharp];
    const pen = canvas.getContext("2d");
    const scale = (0.46 * Math.min(wide, high)) / radius;
    pen.setTransform(sharp * scale, 0, 0, -sharp * scale, (sharp * wide) / 2, (sharp * high) / 2);
    pen.lineCap = "round";
    const [c, s] = [Math.cos(elevation), Math.sin(elevation)];
    const to = [c * Math.cos(azimuth), c * Math.sin(azimuth), s]; // the eye
    const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
    const eye = [right, cross(to, right), to];
    const links = pose(angles);
    const items = [];
    const add = (points, size, colour) => {
      const seen = points.map((p) => apply(eye, p));
      for (let i = 0; i < Math.max(1, seen.length - 1); i += 1) {
        const [a, b] = [seen[i], seen[Math.min(i + 1, seen.length - 1)]];
        items.push({ a, b, size, colour, depth: (a[2] + b[2]) / 2 });
      }
    };
    for (const [link, shapes] of Object.entries(manipulator.shapes)) {
      for (const { points, size, colour } of shapes) {
        add(points.map((p) => apply(links[link], p)), size, colour);
      }
    }
    path.push(apply(links.star, [0, 0, 1.02 * radius]));
    path = path.slice(-PATH);
    add(path, 0.003, "rgba(107, 0, 107, 0.7)");
    for (const { a, b, size, colour } of items.sort((one, other) => one.depth - other.depth)) {
      pen.beginPath();
      if (a === b) {
        pen.arc(a[0], a[1], size, 0, 2 * Math.PI);
        pen.fillStyle = colour;
        pen.fill();
        continue;
      }
      pen.moveTo(a[0], a[1]);
      pen.lineTo(b[0], b[1]);
      pen.lineWidth = 2 * size;
      pen.strokeStyle = colour;
      pen.stroke();
    }
  }

  function show(now) {
    const torque = sliders.map((slider) => Number(slider.value));
    if (running && last !== null) run(Math.min((now - last) / 1000, LONGEST), torque);
    last = now;
    const angles = joints(...y);
    const degrees = angles.slice(0, 3).map((x) => `${((x * 180) / Math.PI).toFixed(1)}°`).join(", ");
    status.textContent = `t = ${t.toFixed(2)} s, γ = ${degrees}`
      + (stopped ? `; stopped: ${stopped}. Reset begins anew.` : "");
    outputs.forEach((output, k) => { output.textContent = `${torque[k].toFixed(2)} N m`; });
    draw(angles);
    requestAnimationFrame(show);
  }

  pause.onclick = () => {
    running = !running;
    pause.textContent = running ? "Pause" : "Resume";
  };
  zero.onclick = () => sliders.forEach((slider) => { slider.value = 0; });
  reset.onclick = begin;
  canvas.onpointerdown = (event) => canvas.setPointerCapture(event.pointerId);
  canvas.onpointermove = (event) => {
    if (!event.buttons) return;
    azimuth -= 0.008 * event.movementX;
    elevation = Math.min(1.5, Math.max(-1.5, elevation + 0.008 * event.movementY));
  };
  begin();
  requestAnimationFrame(show);
}

document.querySelectorAll("#live-manipulator").forEach(start);
