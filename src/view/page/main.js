// The page: layers, cameras, timeline, keyboard.

const PALETTE = { body: [1.0, 0.71, 0.33], left_hand: [0.42, 0.77, 1.0], right_hand: [1.0, 0.48, 0.66], gaze: [0.55, 0.94, 0.55], camera: [0.9, 0.92, 0.95] };
const OTHERS = [[0.75, 0.6, 1.0], [0.4, 0.9, 0.85], [1.0, 0.85, 0.4], [0.95, 0.55, 0.45]];
const KEYS = { body: "b", hands: "h", gaze: "g", camera: "c" };
const names = [...new Set(tracks.flatMap(t => t.parts.map(p => p.layer)))];
const others = names.filter(name => !KEYS[name]);
const colorOf = part => PALETTE[part.name] || OTHERS[others.indexOf(part.layer) % OTHERS.length] || PALETTE.camera;
const title = name => name.charAt(0).toUpperCase() + name.slice(1).replaceAll("_", " ");
const partsOf = layer => tracks.flatMap(t => t.parts).filter(p => p.layer === layer);
const layers = [
  ...[...Object.keys(KEYS).filter(name => names.includes(name)), ...others].map(name => ({ id: name, key: KEYS[name] || "", label: title(name), color: colorOf(partsOf(name)[0]), has: () => true })),
  { id: "depth", key: "d", label: "Depth now", color: [0.6, 0.66, 0.74], has: () => !!depth },
  { id: "cloud", key: "w", label: "World", color: [0.45, 0.5, 0.6], has: () => !!cloud },
  { id: "truth", key: "t", label: "Truth (stippled)", color: [0.8, 0.8, 0.8], has: () => tracks.some(t => t.truth) },
  { id: "samples", key: "s", label: "Other samples (faint)", color: [0.6, 0.6, 0.6], has: () => tracks.some(t => t.ghost) },
].filter(l => l.has()).map(l => ({ ...l, on: true }));
const shown = id => layers.some(l => l.id === id && l.on);

const state = { sample: 0, playing: false, speed: 1, camera: "orbit", yaw: -0.6, pitch: 0.42, distance: 4.2, target: [0, 0.6, -0.7], dirty: true, clock: 0 };
const visibleTracks = () => tracks.filter(t => (!t.truth || shown("truth")) && (!t.ghost || shown("samples")));
const main = tracks.find(t => !t.truth) || tracks[0];
const touch = () => { state.dirty = true; };

// ---- the scene of one moment ------------------------------------------------------------------------------------------

function capsuleChain(part, sample, color, alpha) {
  for (const [a, b, radius] of part.bones) {
    const p = joint(part, sample, a), q = joint(part, sample, b);
    if (p && q) limbs.add(p, q, radius, radius * 0.85, color, alpha);
  }
}
function frustum(camera, size, color, alpha) {
  const [fx, fy, cx, cy] = manifest.lens;
  const corner = (u, v) => add(camera.p, rotate(camera.q, scale([(u - cx) / fx, (v - cy) / fy, 1], size)));
  const corners = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
  corners.forEach((c, i) => { limbs.add(camera.p, c, 0.004, 0.004, color, alpha); limbs.add(c, corners[(i + 1) % 4], 0.004, 0.004, color, alpha); });
  const tip = add(scale(add(corners[0], corners[1]), 0.5), rotate(camera.q, [0, -size * 0.18, 0]));
  limbs.add(corners[0], tip, 0.004, 0.004, color, alpha); limbs.add(tip, corners[1], 0.004, 0.004, color, alpha);
}
function gazeRay(track, part, sample) {
  const camera = pose(track, sample), u = part.values[sample * 2], v = part.values[sample * 2 + 1];
  if (!camera || !Number.isFinite(u) || !Number.isFinite(v)) return null;
  const [fx, fy, cx, cy] = manifest.lens;
  let reach = 1.5;
  if (depth && u >= 0 && v >= 0 && u < 1 && v < 1) {
    const [w, h] = depth.size, z = depth.values[(videoFrame(sample) * h + Math.floor(v * h)) * w + Math.floor(u * w)] * depth.unit;
    if (z > 0.05) reach = z;
  }
  return { from: camera.p, to: add(camera.p, rotate(camera.q, scale([(u - cx) / fx, (v - cy) / fy, 1], reach))) };
}
function path(part, sample, color, alpha) {
  let before = null; const step = Math.max(1, Math.floor(samples / 1200));
  for (let s = 0; s < samples; s += step) { const at = poseOf(part, s); if (at && before) limbs.add(before.p, at.p, 0.006, 0.006, s <= sample ? color : [0.35, 0.38, 0.44], alpha); before = at; }
}
const inside = () => state.camera === "first";
const draw = {
  camera(track, part, sample, color, alpha) {
    path(part, sample, color, alpha);
    const now = poseOf(part, sample); if (now && !inside()) frustum(now, 0.16, color, alpha);
  },
  pose(track, part, sample, color, alpha) {
    path(part, sample, color, alpha);
    const now = poseOf(part, sample); if (!now) return;
    [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]].forEach((axis, k) => limbs.add(now.p, add(now.p, rotate(now.q, axis)), 0.008, 0.008, color.map((c, i) => i === k ? 1 : c * 0.5), alpha));
  },
  point(track, part, sample, color, alpha) {
    const ray = gazeRay(track, part, sample); if (!ray) return;
    if (!inside()) limbs.add(ray.from, ray.to, 0.005, 0.005, color, alpha);
    limbs.add(ray.to, ray.to, 0.03, 0.03, color, alpha);
  },
  // The own body would hide what the first person sees; the hands are part of it.
  joints(track, part, sample, color, alpha) { if (part.in_image || !inside()) capsuleChain(part, sample, color, alpha); },
  plot() {},
};
function drawTrack(track, sample) {
  for (const part of track.parts) if (shown(part.layer)) draw[part.kind](track, part, sample, colorOf(part), track.truth ? 0.5 : track.ghost ? 0.22 : 1);
}
function drawFloor() {
  const z = manifest.floor; if (z == null) return;
  const centre = (main && pose(main, state.sample) || { p: [0, 0, 0] }).p, cx = Math.round(centre[0]), cy = Math.round(centre[1]);
  for (let k = -5; k <= 5; k++) {
    limbs.add([cx + k, cy - 5, z], [cx + k, cy + 5, z], 0.003, 0.003, [0.2, 0.23, 0.28]);
    limbs.add([cx - 5, cy + k, z], [cx + 5, cy + k, z], 0.003, 0.003, [0.2, 0.23, 0.28]);
  }
}
function viewMatrix() {
  const aspect = canvas.width / Math.max(canvas.height, 1), camera = main && pose(main, state.sample);
  if (state.camera === "first" && camera) {
    const fovy = 2 * Math.atan(0.5 / manifest.lens[1]) * 1.15;
    const forward = rotate(camera.q, [0, 0, 1]), up = rotate(camera.q, [0, -1, 0]);
    return multiply(perspective(fovy, aspect, 0.02, 100), lookAt(camera.p, add(camera.p, forward), up));
  }
  let target = state.target;
  if (state.camera === "follow" && camera) target = add(camera.p, [0, 0, -0.6]);
  const c = Math.cos(state.pitch), eye = add(target, scale([Math.sin(state.yaw) * c, -Math.cos(state.yaw) * c, Math.sin(state.pitch)], state.distance));
  return multiply(perspective(0.8, aspect, 0.03, 200), lookAt(eye, target, [0, 0, 1]));
}
function render() {
  if (!gl) return;
  const ratio = Math.min(window.devicePixelRatio || 1, 2), w = Math.max(1, Math.round(canvas.clientWidth * ratio)), h = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  gl.viewport(0, 0, w, h); gl.clearColor(0.059, 0.071, 0.086, 1); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST); gl.disable(gl.CULL_FACE);
  const view = viewMatrix(), frame = videoFrame(state.sample);
  if (worldPoints && shown("cloud")) worldPoints.draw(view);
  const camera = main && pose(main, state.sample);
  if (framePoints && camera && shown("depth")) framePoints.draw(view, frame, camera, video && video.get(frame, touch));
  limbs.begin(); drawFloor();
  for (const track of visibleTracks()) drawTrack(track, state.sample);
  limbs.draw(view);
}

// ---- the video beside it ----------------------------------------------------------------------------------------------

const picture = document.getElementById("video"), ink = picture.getContext("2d");
function renderVideo() {
  const size = picture.width, frame = videoFrame(state.sample), image = video && video.get(frame, touch);
  if (image) { ink.drawImage(image, 0, 0, size, size); } else if (!video) { ink.fillStyle = "#000"; ink.fillRect(0, 0, size, size); }
  if (video && !image) return;
  for (const track of visibleTracks()) {
    ink.setLineDash(track.truth ? [3, 4] : []);
    for (const part of track.parts) if (shown(part.layer)) {
      ink.strokeStyle = `rgb(${colorOf(part).map(c => c * 255)})`;
      if (part.kind === "joints" && part.in_image) project(track, part, size);
      if (part.kind !== "point") continue;
      const u = part.values[state.sample * 2], v = part.values[state.sample * 2 + 1];
      if (Number.isFinite(u) && Number.isFinite(v)) { ink.lineWidth = 3; ink.beginPath(); ink.arc(u * size, v * size, 13, 0, 7); ink.stroke(); }
    }
  }
  ink.setLineDash([]);
}
function project(track, part, size) {
  const camera = pose(track, state.sample); if (!camera) return;
  const [fx, fy, cx, cy] = manifest.lens, back = [-camera.q[0], -camera.q[1], -camera.q[2], camera.q[3]];
  const place = index => { const p = joint(part, state.sample, index); if (!p) return null; const c = rotate(back, sub(p, camera.p)); return c[2] > 0.05 ? [(c[0] / c[2] * fx + cx) * size, (c[1] / c[2] * fy + cy) * size] : null; };
  ink.lineWidth = 2; ink.beginPath();
  for (const [a, b] of part.bones) { const p = place(a), q = place(b); if (p && q) { ink.moveTo(...p); ink.lineTo(...q); } }
  ink.stroke();
}

// ---- curves of what has no place in the scene -------------------------------------------------------------------------

const plots = names.map(layer => ({ layer, parts: tracks.flatMap(t => t.parts.filter(p => p.layer === layer && p.kind === "plot" && !t.ghost).map(p => ({ ...p, truth: t.truth }))) })).filter(p => p.parts.length);
for (const plot of plots) {
  const [{ channels, units, width }] = plot.parts;
  let [low, high] = [Infinity, -Infinity];
  for (const part of plot.parts) for (const v of part.values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
  Object.assign(plot, { low, span: Math.max(high - low, 1e-9) });
  plot.canvas = make("canvas", ""); plot.canvas.height = 64; plot.canvas.className = "plot";
  const figure = make("figure", ""); figure.append(make("figcaption", `${title(plot.layer)}: ${channels.join(", ") || width + " channels"}${units.length ? " (" + [...new Set(units)].join(", ") + ")" : ""}`), plot.canvas);
  document.getElementById("plots").append(figure);
}
function drawPlots() {
  for (const { canvas, parts, layer, low, span } of plots) {
    canvas.parentElement.hidden = !shown(layer);
    const w = canvas.width = Math.max(1, canvas.clientWidth), h = canvas.height, pen = canvas.getContext("2d"), step = Math.max(1, Math.floor(samples / (2 * w)));
    for (const part of parts) {
      if (part.truth && !shown("truth")) continue;
      pen.setLineDash(part.truth ? [3, 3] : []);
      for (let c = 0; c < part.width; c++) {
        pen.strokeStyle = `hsl(${c * 67 + 200} 70% 65%)`; pen.beginPath(); let down = false;
        for (let s = 0; s < samples; s += step) { const v = part.values[s * part.width + c]; if (!Number.isFinite(v)) { down = false; continue; } const at = [s / Math.max(samples - 1, 1) * w, h - 3 - (v - low) / span * (h - 6)]; if (down) pen.lineTo(...at); else pen.moveTo(...at); down = true; }
        pen.stroke();
      }
    }
    pen.setLineDash([]); pen.strokeStyle = "#fff8"; const x = state.sample / Math.max(samples - 1, 1) * w; pen.beginPath(); pen.moveTo(x, 0); pen.lineTo(x, h); pen.stroke();
  }
}

// ---- controls ---------------------------------------------------------------------------------------------------------

const $ = id => document.getElementById(id);
function report(text) { errors.push(text); const n = document.getElementById("notice"); n.hidden = false; n.textContent = text; }
function make(tag, text, className) { const e = document.createElement(tag); e.textContent = text; if (className) e.className = className; return e; }

$("title").textContent = manifest.title; document.title = manifest.title;
for (const badge of manifest.badges) $("badges").append(make("span", badge.text, "badge " + badge.kind));
for (const fact of manifest.facts) $("facts").append(make("dt", fact.label), make("dd", fact.value));
for (const layer of layers) {
  const button = make("button", layer.label); const swatch = make("span", "", "swatch");
  swatch.style.background = `rgb(${layer.color.map(c => c * 255)})`; button.prepend(swatch);
  button.title = layer.key ? `Show or hide (${layer.key})` : "Show or hide"; button.onclick = () => toggle(layer.id); layer.button = button; $("toggles").append(button);
}
function toggle(id) { const l = layers.find(x => x.id === id); if (l) { l.on = !l.on; l.button.setAttribute("aria-pressed", l.on); touch(); } }
for (const l of layers) l.button.setAttribute("aria-pressed", "true");
function setCamera(name) { state.camera = name; for (const b of document.querySelectorAll("[data-camera]")) b.setAttribute("aria-pressed", b.dataset.camera === name); touch(); }
for (const b of document.querySelectorAll("[data-camera]")) b.onclick = () => setCamera(b.dataset.camera);
function seek(sample) { state.sample = Math.max(0, Math.min(samples - 1, Math.round(sample))); state.clock = state.sample / rate; touch(); }
function play(on) { state.playing = on; if (on && state.sample >= samples - 1) seek(0); $("play").innerHTML = on ? "&#10074;&#10074;" : "&#9654;"; }
$("time").max = samples - 1; $("time").oninput = e => { play(false); seek(+e.target.value); };
$("play").onclick = () => play(!state.playing);
$("speed").onchange = e => { state.speed = +e.target.value; };
$("help-button").onclick = () => $("help").showModal();
const keys = [["Space", "play or pause"], ["Left / Right", "one frame back or on (Shift: one second)"], ["Home / End", "start or end"], ["1 2 3", "orbit, follow, first person"],
  ...layers.filter(l => l.key).map(l => [l.key.toUpperCase(), "show or hide: " + l.label]), ["Drag / wheel", "turn, zoom (right drag or two fingers: move)"], ["?", "this list"]];
for (const [key, does] of keys) { const row = document.createElement("tr"), cell = document.createElement("td"); cell.append(make("kbd", key)); row.append(cell, make("td", does)); $("keys").append(row); }
addEventListener("keydown", e => {
  if (e.target.tagName === "SELECT" || e.ctrlKey || e.metaKey || e.altKey) return;
  const jump = e.shiftKey ? rate : 1, layer = layers.find(l => l.key === e.key.toLowerCase());
  if (e.key === " ") play(!state.playing); else if (e.key === "ArrowLeft") { play(false); seek(state.sample - jump); } else if (e.key === "ArrowRight") { play(false); seek(state.sample + jump); }
  else if (e.key === "Home") seek(0); else if (e.key === "End") seek(samples - 1);
  else if (e.key === "1") setCamera("orbit"); else if (e.key === "2") setCamera("follow"); else if (e.key === "3") setCamera("first");
  else if (e.key === "?") $("help").showModal(); else if (layer) toggle(layer.id); else return;
  e.preventDefault();
});

const pointers = new Map(); let spread = 0;
canvas.addEventListener("pointerdown", e => { canvas.setPointerCapture(e.pointerId); pointers.set(e.pointerId, [e.clientX, e.clientY]); spread = 0; });
for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, e => { pointers.delete(e.pointerId); spread = 0; });
canvas.addEventListener("contextmenu", e => e.preventDefault());
canvas.addEventListener("pointermove", e => {
  const before = pointers.get(e.pointerId); if (!before) return;
  let dx = e.clientX - before[0], dy = e.clientY - before[1]; pointers.set(e.pointerId, [e.clientX, e.clientY]);
  if (pointers.size === 2) {
    const [a, b] = [...pointers.values()], now = Math.hypot(a[0] - b[0], a[1] - b[1]);
    if (spread) zoom(spread / now); spread = now; pan(dx / 2, dy / 2);
  } else if (e.buttons & 2 || e.shiftKey) pan(dx, dy);
  else { state.yaw -= dx * 0.006; state.pitch = Math.max(-1.45, Math.min(1.5, state.pitch + dy * 0.006)); }
  touch();
});
function zoom(by) { state.distance = Math.max(0.2, Math.min(60, state.distance * by)); touch(); }
function pan(dx, dy) {
  const s = state.distance / canvas.clientHeight * 0.85, right = [Math.cos(state.yaw), Math.sin(state.yaw), 0];
  state.target = add(state.target, add(scale(right, -dx * s), [0, 0, dy * s]));
}
canvas.addEventListener("wheel", e => { e.preventDefault(); zoom(Math.exp(e.deltaY * 0.001)); }, { passive: false });
addEventListener("resize", touch);

function drawCertainty() {
  const strip = $("certainty"); if (!certainty.length) { strip.hidden = true; return; }
  const w = strip.width = Math.max(1, strip.clientWidth), h = strip.height, pen = strip.getContext("2d"), row = h / certainty.length;
  certainty.forEach((c, k) => {
    const color = PALETTE[c.name] || [0.6, 0.66, 0.74];
    for (let x = 0; x < w; x++) {
      const v = c.values[Math.floor(x / w * c.values.length)];
      pen.fillStyle = Number.isFinite(v) ? `rgba(${color.map(q => q * 255)},${0.12 + 0.88 * Math.max(0, Math.min(1, v))})` : "#0000";
      pen.fillRect(x, k * row, 1, row - 1);
    }
  });
  strip.title = "Token certainty (1 less the entropy, not an accuracy), top to bottom: " + certainty.map(c => c.name).join(", ");
}

function clockText(s) { const m = Math.floor(s / 60); return `${m}:${(s - 60 * m).toFixed(2).padStart(5, "0")}`; }
let last = 0;
function frame(now) {
  if (state.playing) {
    state.clock += Math.min(now - last, 200) / 1000 * state.speed;
    const sample = Math.floor(state.clock * rate);
    if (sample >= samples) { seek(samples - 1); play(false); } else if (sample !== state.sample) { state.sample = sample; touch(); }
  }
  last = now;
  if (state.dirty) {
    state.dirty = false; render(); renderVideo(); drawPlots();
    $("time").value = state.sample; $("clock").textContent = `${clockText(state.sample / rate)} / ${clockText((samples - 1) / rate)}`;
  }
  requestAnimationFrame(frame);
}
if (!gl) report("This browser has no WebGL2: the 3D scene cannot be drawn. Video, gaze and numbers are shown.");
const middle = main && pose(main, Math.floor(samples / 2)); if (middle) state.target = add(middle.p, [0, 0.4, -0.6]);
setCamera("orbit"); addEventListener("resize", drawCertainty); drawCertainty();
const start = /[#&]t=([\d.]+)/.exec(location.hash); if (start) seek(+start[1] * rate);
if (/[#&]camera=(\w+)/.test(location.hash)) setCamera(/[#&]camera=(\w+)/.exec(location.hash)[1]);
requestAnimationFrame(frame);

// The page can examine itself: `#selftest` draws two moments and writes what it saw into the document.
if (/selftest/.test(location.hash)) {
  const look = sample => { seek(sample); render(); const p = new Uint8Array(canvas.width * canvas.height * 4); gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, p); return p; };
  setTimeout(() => {
    const result = { webgl: !!gl, errors };
    if (gl) {
      for (const id of ["depth", "cloud", "gaze", "camera"]) if (shown(id)) toggle(id);
      const a = look(0), b = look(samples - 1); let drawn = 0, moved = 0;
      for (let i = 0; i < a.length; i += 4) { if (a[i] > 40) drawn++; if (a[i] !== b[i] || a[i + 1] !== b[i + 1]) moved++; }
      for (const id of ["depth", "cloud", "gaze", "camera"]) toggle(id);
      const all = look(0); let full = 0; for (let i = 0; i < all.length; i += 4) if (all[i] > 40) full++;
      Object.assign(result, { drawn, moved, full, gl: gl.getError(), clock: $("clock").textContent });
      const t = performance.now(); for (let k = 0; k < 20; k++) { seek(k * samples / 20); render(); } gl.finish(); result.ms_per_frame = (performance.now() - t) / 20;
    }
    const out = make("pre", JSON.stringify(result)); out.id = "selftest"; document.body.append(out);
  }, 600);
}
