// Drawing: one WebGL2 context, instanced limbs (capsules made of a cylinder and two balls), point clouds.

const canvas = document.getElementById("world");
const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, "#version 300 es\nprecision highp float; precision highp int; precision highp usampler2D;\n" + text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) report("shader: " + gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) report("program: " + gl.getProgramInfoLog(made));
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
    const name = gl.getActiveUniform(made, i).name; uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms };
}

// A capsule is a sphere whose upper half is moved to `b` and lower half to `a`.
const capsuleMesh = (() => {
  const slices = 14, stacks = 5, points = [], indices = [];
  const ring = (polar, half) => { for (let s = 0; s <= slices; s++) { const t = s / slices * 2 * Math.PI; points.push(Math.sin(polar) * Math.cos(t), Math.sin(polar) * Math.sin(t), Math.cos(polar), half); } };
  for (let k = 0; k <= stacks; k++) ring(k / stacks * Math.PI / 2, 1);
  for (let k = 0; k <= stacks; k++) ring(Math.PI / 2 + k / stacks * Math.PI / 2, 0);
  const row = slices + 1;
  for (let k = 0; k < 2 * stacks + 1; k++) for (let s = 0; s < slices; s++) { const a = k * row + s; indices.push(a, a + row, a + 1, a + 1, a + row, a + row + 1); }
  return { points: new Float32Array(points), indices: new Uint16Array(indices) };
})();

const limbs = gl && (() => {
  const { made, uniforms } = program(`
    layout(location=0) in vec4 point; layout(location=1) in vec4 a; layout(location=2) in vec4 b; layout(location=3) in vec4 color;
    uniform mat4 view; out vec3 normal; out vec4 tint;
    void main() {
      vec3 axis = b.xyz - a.xyz; float len = length(axis);
      vec3 z = len > 1e-6 ? axis / len : vec3(0, 0, 1);
      vec3 x = normalize(abs(z.z) < 0.9 ? cross(vec3(0, 0, 1), z) : cross(vec3(1, 0, 0), z)), y = cross(z, x);
      normal = x * point.x + y * point.y + z * point.z;
      float radius = mix(a.w, b.w, point.w);
      gl_Position = view * vec4(mix(a.xyz, b.xyz, point.w) + normal * radius, 1); tint = color;
    }`, `
    in vec3 normal; in vec4 tint; uniform vec3 eye; out vec4 shade;
    void main() {
      vec3 n = normalize(normal);
      float light = 0.45 + 0.4 * max(dot(n, normalize(vec3(0.3, -0.5, 0.9))), 0.0) + 0.15 * max(n.z, 0.0);
      if (tint.a < 0.99) { ivec2 p = ivec2(gl_FragCoord.xy); if (float((p.x + 2 * p.y) & 3) / 4.0 > tint.a - 0.05) discard; }
      shade = vec4(tint.rgb * light, 1);
    }`);
  const array = gl.createVertexArray(); gl.bindVertexArray(array);
  const mesh = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, mesh); gl.bufferData(gl.ARRAY_BUFFER, capsuleMesh.points, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0); gl.vertexAttribPointer(0, 4, gl.FLOAT, false, 0, 0);
  const index = gl.createBuffer(); gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index); gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, capsuleMesh.indices, gl.STATIC_DRAW);
  const instances = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, instances);
  for (let i = 0; i < 3; i++) { gl.enableVertexAttribArray(1 + i); gl.vertexAttribPointer(1 + i, 4, gl.FLOAT, false, 48, i * 16); gl.vertexAttribDivisor(1 + i, 1); }
  gl.bindVertexArray(null);
  let list = [];
  return {
    begin() { list = []; },
    add(a, b, radiusA, radiusB, [r, g, blue], alpha = 1) { list.push(a[0], a[1], a[2], radiusA, b[0], b[1], b[2], radiusB, r, g, blue, alpha); },
    draw(view) {
      if (!list.length) return;
      gl.useProgram(made); gl.uniformMatrix4fv(uniforms.view, false, view);
      gl.bindVertexArray(array); gl.bindBuffer(gl.ARRAY_BUFFER, instances); gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(list), gl.DYNAMIC_DRAW);
      gl.drawElementsInstanced(gl.TRIANGLES, capsuleMesh.indices.length, gl.UNSIGNED_SHORT, 0, list.length / 12);
      gl.bindVertexArray(null);
    },
  };
})();

function texture(filter) {
  const made = gl.createTexture(); gl.bindTexture(gl.TEXTURE_2D, made);
  for (const [key, value] of [[gl.TEXTURE_MIN_FILTER, filter], [gl.TEXTURE_MAG_FILTER, filter], [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE]]) gl.texParameteri(gl.TEXTURE_2D, key, value);
  return made;
}

// The depth of one video frame, lifted by its camera and coloured by that same frame.
const framePoints = gl && depth && (() => {
  const { made, uniforms } = program(`
    uniform usampler2D depths; uniform sampler2D image; uniform mat4 view; uniform vec4 turn; uniform vec3 origin; uniform vec4 lens; uniform vec2 size; uniform float unit; uniform float dot_size; uniform bool coloured; out vec3 color;
    void main() {
      int w = int(size.x); ivec2 cell = ivec2(gl_VertexID % w, gl_VertexID / w);
      float z = float(texelFetch(depths, cell, 0).r) * unit;
      vec2 uv = (vec2(cell) + 0.5) / size;
      vec3 p = vec3((uv - lens.zw) / lens.xy * z, z);
      vec3 t = 2.0 * cross(turn.xyz, p); p = p + turn.w * t + cross(turn.xyz, t) + origin;
      color = coloured ? texture(image, uv).rgb : vec3(0.55, 0.6, 0.68);
      gl_Position = z > 0.0 ? view * vec4(p, 1) : vec4(2, 2, 2, 1);
      gl_PointSize = clamp(dot_size / gl_Position.w, 1.0, 14.0);
    }`, `in vec3 color; out vec4 shade; void main() { shade = vec4(color, 1); }`);
  const depths = texture(gl.NEAREST), image = texture(gl.LINEAR), array = gl.createVertexArray();
  let heldDepth = -1, heldImage = -1;
  return {
    draw(view, frame, camera, picture) {
      const [w, h] = depth.size;
      gl.useProgram(made);
      gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, depths);
      if (heldDepth !== frame) {
        gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.R16UI, w, h, 0, gl.RED_INTEGER, gl.UNSIGNED_SHORT, depth.values.subarray(frame * w * h, (frame + 1) * w * h));
        heldDepth = frame;
      }
      gl.activeTexture(gl.TEXTURE1); gl.bindTexture(gl.TEXTURE_2D, image);
      if (picture && heldImage !== frame) { gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture); heldImage = frame; }
      gl.uniform1i(uniforms.depths, 0); gl.uniform1i(uniforms.image, 1); gl.uniform1i(uniforms.coloured, heldImage >= 0 ? 1 : 0);
      gl.uniformMatrix4fv(uniforms.view, false, view); gl.uniform4fv(uniforms.turn, camera.q); gl.uniform3fv(uniforms.origin, camera.p);
      gl.uniform4fv(uniforms.lens, manifest.lens); gl.uniform2f(uniforms.size, w, h); gl.uniform1f(uniforms.unit, depth.unit);
      gl.uniform1f(uniforms.dot_size, canvas.height * 1.6 / h * 2.2);
      gl.bindVertexArray(array); gl.drawArrays(gl.POINTS, 0, w * h); gl.bindVertexArray(null);
    },
  };
})();

// The points of the whole recording: quantised positions and colours, made when the page was written.
const worldPoints = gl && cloud && (() => {
  const { made, uniforms } = program(`
    layout(location=0) in vec3 place; layout(location=1) in vec3 tint; uniform mat4 view; uniform vec3 low; uniform float span; uniform float dot_size; out vec3 color;
    void main() { gl_Position = view * vec4(low + place * span, 1); color = tint; gl_PointSize = clamp(dot_size / gl_Position.w, 1.0, 8.0); }`,
    `in vec3 color; out vec4 shade; void main() { shade = vec4(color * 0.8, 1); }`);
  const array = gl.createVertexArray(); gl.bindVertexArray(array);
  const buffer = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, cloud.bytes, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0); gl.vertexAttribPointer(0, 3, gl.UNSIGNED_SHORT, true, 10, 0);
  gl.enableVertexAttribArray(1); gl.vertexAttribPointer(1, 3, gl.UNSIGNED_BYTE, true, 10, 6);
  gl.bindVertexArray(null);
  return {
    draw(view) {
      gl.useProgram(made); gl.uniformMatrix4fv(uniforms.view, false, view); gl.uniform3fv(uniforms.low, cloud.low); gl.uniform1f(uniforms.span, cloud.span);
      gl.uniform1f(uniforms.dot_size, canvas.height * 0.012);
      gl.bindVertexArray(array); gl.drawArrays(gl.POINTS, 0, cloud.bytes.length / 10); gl.bindVertexArray(null);
    },
  };
})();
