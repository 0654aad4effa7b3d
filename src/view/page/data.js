// Every failure is shown on the page and kept for the self-test.
const errors = [];
addEventListener("error", e => report(String(e.message)));
addEventListener("unhandledrejection", e => report(String(e.reason)));

// Data: the manifest and its binary blobs. All positions are metres in the world of the manifest (z up).

const manifest = JSON.parse(document.getElementById("manifest").textContent);

function bytesOf(name) {
  const element = document.getElementById("blob-" + name);
  if (!element) return null;
  const text = element.textContent;
  element.remove(); // the text is not needed twice
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}
const floatsOf = name => { const b = bytesOf(name); return b && new Float32Array(b.buffer, 0, b.length >> 2); };

// A track is one version of the wearer: the prediction, or the truth beside it. Its parts are modalities, each with the kind of
// its drawing and `width` numbers per sample, NaN where unknown.
const tracks = manifest.tracks.map(track => {
  const parts = track.parts.map(part => ({ ...part, values: floatsOf(track.name + "-" + part.name) }));
  return { ...track, parts, camera: parts.find(part => part.kind === "camera") };
});

const depth = (() => {
  const info = manifest.depth; if (!info) return null;
  const bytes = bytesOf("depth"); if (!bytes) return null;
  return { ...info, values: new Uint16Array(bytes.buffer, 0, bytes.length >> 1) };
})();
const cloud = manifest.cloud ? { ...manifest.cloud, bytes: bytesOf("cloud") } : null;
const certainty = (manifest.certainty || []).map(c => ({ ...c, values: floatsOf("certainty-" + c.name) }));

// Video frames are decoded when they are looked at, and a few are kept.
const video = (() => {
  const info = manifest.video; if (!info) return null;
  const bytes = bytesOf("video"), kept = new Map(), wanted = new Set();
  return {
    ...info,
    get(frame, ready) {
      const image = kept.get(frame);
      if (image) { kept.delete(frame); kept.set(frame, image); return image; }
      if (!wanted.has(frame)) {
        wanted.add(frame);
        const part = bytes.subarray(info.offsets[frame], info.offsets[frame + 1]);
        createImageBitmap(new Blob([part], { type: "image/jpeg" })).then(made => {
          wanted.delete(frame); kept.set(frame, made);
          if (kept.size > 48) { const [oldest, old] = kept.entries().next().value; kept.delete(oldest); old.close(); }
          ready();
        }, error => { wanted.delete(frame); report("video frame " + frame + ": " + error.message); });
      }
      return null;
    },
  };
})();

const samples = manifest.samples, rate = manifest.rate;
const videoFrame = sample => video ? Math.min(Math.floor(sample / rate * video.rate + 1e-6), video.count - 1) : 0;

// Small vector algebra, column-major 4x4 for WebGL.
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = a => scale(a, 1 / Math.max(Math.hypot(...a), 1e-9));
const finite = a => a.every(Number.isFinite);
function rotate([x, y, z, w], v) {
  const q = [x, y, z], t = scale(cross(q, v), 2);
  return add(add(v, scale(t, w)), cross(q, t));
}
function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    let s = 0; for (let k = 0; k < 4; k++) s += a[k * 4 + r] * b[c * 4 + k];
    out[c * 4 + r] = s;
  }
  return out;
}
function perspective(fovy, aspect, near, far) {
  const f = 1 / Math.tan(fovy / 2), d = 1 / (near - far);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) * d, -1, 0, 0, 2 * far * near * d, 0]);
}
function lookAt(eye, target, up) {
  const z = unit(sub(eye, target));
  let x = cross(up, z); if (Math.hypot(...x) < 1e-6) x = cross([0, 1, 0], z);
  x = unit(x); const y = cross(z, x);
  return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1]);
}
// Position and quaternion x y z w of a part's row.
function poseOf(part, sample) {
  const at = sample * 7, p = Array.from(part.values.subarray(at, at + 3)), q = Array.from(part.values.subarray(at + 3, at + 7));
  return finite(p) && finite(q) ? { p, q } : null;
}
const pose = (track, sample) => track.camera ? poseOf(track.camera, sample) : null;
function joint(part, sample, index) {
  const at = sample * part.width + index * 3;
  const p = [part.values[at], part.values[at + 1], part.values[at + 2]];
  return finite(p) ? p : null;
}
