// A grasp in 3D on a WebGL 2 canvas: skinned meshes over time, orbit camera, contact forces, play, pause, slider.
//
// Why not a library: three.js, which anythreejs and viser carry on the index, would add 0.6 to 0.8 MB to each report,
// where this file has 0.02; what it offers beside a renderer (orbit camera, smooth normals, arrows) are some sixty
// lines here, and skinning by two bodies at any time would be ours all the same.  viser 1.1 plays by messages of its
// server, which has no hook for a token or an origin and needs older versions of rich and websockets.  plotly redraws
// a figure of such meshes in 0.2 s and ignores the mouse while it plays.
//
// startReplay(root, data) fills an element; `load` of what it returns shows another grasp there, from where the
// camera stands and at the same time.  The element gets an event "time" for each frame, and "pick" with the name of
// a part that was clicked.  data has
//   parts   name, color [r, g, b], and base64 arrays: first, second (float32, 3 a vertex: places in the
//           frames of two bodies), body (uint16, 2 a vertex), weight (float32, of the second body) and
//           face (uint32, 3 a triangle).  A vertex is (1 - w) T_first(first) + w T_second(second).
//   poses   base64 float32 (frame, body, 7): position [m] and unit quaternion (w, x, y, z)
//   sizes   base64 float32 (frame, body, 2): factors of y and z of what is on the bodies, or null for 1
//   bodies, frames, rate [frames/s], phases [[name, end time s], ...], camera, table, object
//   contacts  base64 arrays count (uint16, contacts of each frame) and values (float32, 7 a contact: number of the part
//           that presses on the object, point [m], force on the object [N]), or null
//   strip   pictures [[caption, base64 WebP], ...] for a browser without WebGL 2
//   turn    whether the camera turns and the grasp plays once it is seen, unless the reader wants less motion
"use strict";

// Pictures in place of the 3D view and its controls.
function showStrip(root, strip) {
  const find = (name) => root.querySelector(`.${name}`);
  const offer = "This browser offers no WebGL 2; its settings may have hardware acceleration switched off. ";
  find("message").textContent = offer + (strip.length ? "Pictures stand in place of the 3D view." : "Pictures follow.");
  const figures = strip.map(([caption, webp]) => {
    const figure = document.createElement("figure"), picture = document.createElement("img");
    const words = document.createElement("figcaption");
    picture.src = `data:image/webp;base64,${webp}`;
    picture.alt = words.textContent = caption;
    figure.append(picture, words);
    return figure;
  });
  find("strip").replaceChildren(...figures);
  root.classList.add("still");
}

function startReplay(root, data) {
  function decode(text, type) {
    const raw = atob(text), bytes = new Uint8Array(raw.length);
    for (let k = 0; k < raw.length; k++) bytes[k] = raw.charCodeAt(k);  // Uint8Array.from would call a function for each byte
    return new type(bytes.buffer);
  }
  const find = (name) => root.querySelector(`.${name}`);
  const canvas = find("view"), slider = find("time"), button = find("play"), label = find("label");
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, stencil: true,
    preserveDrawingBuffer: true });
  if (!gl) {
    showStrip(root, data.strip);
    return null;
  }

  // ---- meshes: triangles whose corners have a place and a normal each
  let parts = [], poses, sizes, end, now, grown, contacts;  // now: poses at the time shown; grown: sizes then
  function take(grasp) {
    data = grasp;
    for (const p of parts) gl.deleteBuffer(p.buffer);
    poses = decode(data.poses, Float32Array);
    sizes = data.sizes && decode(data.sizes, Float32Array);
    end = (data.frames - 1) / data.rate;
    now = new Float32Array(7 * data.bodies);
    grown = new Float32Array(2 * data.bodies).fill(1);
    parts = data.parts.map((p) => {
      const face = decode(p.face, Uint32Array), buffer = gl.createBuffer();
      const first = decode(p.first, Float32Array), second = decode(p.second, Float32Array);
      const vertices = new Float32Array(first.length), corners = new Float32Array(6 * face.length);
      return { ...p, face, first, second, buffer, vertices, corners,
        body: decode(p.body, Uint16Array), weight: decode(p.weight, Float32Array) };
    });
    poseAt(0);
    for (const p of parts) {
      place(p);
      p.slot = smoothed(p);
      p.normals = new Float32Array(3 * (1 + p.slot.reduce((most, slot) => Math.max(most, slot), 0)));
    }
    contacts = data.contacts ? byFrame(decode(data.contacts.count, Uint16Array), decode(data.contacts.values, Float32Array)) : null;
    find("forces").parentElement.hidden = !contacts;
    slider.max = end;
  }
  // Contacts of each frame as forces by part: {part, force [N], point: their middle [m], points}.
  function byFrame(count, values) {
    let k = 0;
    return Array.from(count, (many) => {
      const sums = new Map();
      for (const last = k + many; k < last; k++) {
        const [part, x, y, z, ...force] = values.subarray(7 * k, 7 * k + 7), size = Math.hypot(...force);
        if (!sums.has(part)) sums.set(part, { part, force: [0, 0, 0], point: [0, 0, 0], points: [], size: 0 });
        const sum = sums.get(part);
        sum.size += size;
        sum.points.push([x, y, z]);
        [x, y, z].forEach((v, i) => { sum.point[i] += size * v; sum.force[i] += force[i]; });
      }
      return [...sums.values()].filter(({ size }) => size > 0).map((sum) => ({ ...sum, point: sum.point.map((v) => v / sum.size) }));
    });
  }

  // Normal of a face, twice as long as its area.
  function across(p, c, out) {
    const v = p.vertices, [i, j, k] = [3 * p.face[c], 3 * p.face[c + 1], 3 * p.face[c + 2]];
    const ax = v[j] - v[i], ay = v[j + 1] - v[i + 1], az = v[j + 2] - v[i + 2];
    const bx = v[k] - v[i], by = v[k + 1] - v[i + 1], bz = v[k + 2] - v[i + 2];
    out[0] = ay * bz - az * by;
    out[1] = az * bx - ax * bz;
    out[2] = ax * by - ay * bx;
  }
  // For each corner the number of its normal: corners of a vertex share one unless faces meet there at an edge.
  function smoothed(p) {
    const EDGE = Math.cos(Math.PI / 3), n = [0, 0, 0], slot = new Uint32Array(p.face.length);
    const known = new Map();  // by place: a mesh may have a place several times
    let count = 0;
    for (let c = 0; c < p.face.length; c += 3) {
      across(p, c, n);
      const size = Math.hypot(...n) || 1;
      for (let i = 0; i < 3; i++) {
        const at = 3 * p.face[c + i], key = [0, 1, 2].map((a) => Math.round(1e6 * p.vertices[at + a])).join();
        const normals = known.get(key) || known.set(key, []).get(key);
        let match = normals.find((other) => (other.n[0] * n[0] + other.n[1] * n[1] + other.n[2] * n[2]) / size > EDGE);
        if (!match) {
          match = { n: n.map((x) => x / size), slot: count++ };
          normals.push(match);
        }
        slot[c + i] = match.slot;
      }
    }
    return slot;
  }

  // Poses between two frames: positions, sizes and (normalised) quaternions are interpolated linearly.
  function poseAt(time) {
    const at = Math.min(Math.max(time * data.rate, 0), data.frames - 1);
    const k = Math.min(Math.floor(at), Math.max(data.frames - 2, 0)), w = at - k;
    const stride = 7 * data.bodies, next = Math.min(k + 1, data.frames - 1);
    for (let b = 0; b < data.bodies; b++) {
      const p = k * stride + 7 * b, q = next * stride + 7 * b, o = 7 * b;
      let sign = 0, norm = 0;
      for (let i = 3; i < 7; i++) sign += poses[p + i] * poses[q + i];
      sign = sign < 0 ? -1 : 1;
      for (let i = 0; i < 7; i++) now[o + i] = (1 - w) * poses[p + i] + w * (i < 3 ? 1 : sign) * poses[q + i];
      for (let i = 3; i < 7; i++) norm += now[o + i] ** 2;
      for (let i = 3; i < 7; i++) now[o + i] /= Math.sqrt(norm);
    }
    const many = grown.length;
    if (sizes) for (let i = 0; i < many; i++) grown[i] = (1 - w) * sizes[k * many + i] + w * sizes[next * many + i];
  }

  // Adds weight * T_body(local[3 v ...]) to out[3 v ...].
  function add(out, v, local, body, weight) {
    const o = 7 * body, x = local[3 * v], y = grown[2 * body] * local[3 * v + 1], z = grown[2 * body + 1] * local[3 * v + 2];
    const qw = now[o + 3], qx = now[o + 4], qy = now[o + 5], qz = now[o + 6];
    const tx = 2 * (qy * z - qz * y), ty = 2 * (qz * x - qx * z), tz = 2 * (qx * y - qy * x);
    out[3 * v] += weight * (now[o] + x + qw * tx + qy * tz - qz * ty);
    out[3 * v + 1] += weight * (now[o + 1] + y + qw * ty + qz * tx - qx * tz);
    out[3 * v + 2] += weight * (now[o + 2] + z + qw * tz + qx * ty - qy * tx);
  }

  function place(p) {
    p.vertices.fill(0);
    for (let v = 0; v < p.weight.length; v++) {
      add(p.vertices, v, p.first, p.body[2 * v], 1 - p.weight[v]);
      if (p.weight[v] > 0) add(p.vertices, v, p.second, p.body[2 * v + 1], p.weight[v]);
    }
  }
  function skin(time) {
    const n = [0, 0, 0];
    poseAt(time);
    for (const p of parts) {
      place(p);
      p.normals.fill(0);
      for (let c = 0; c < p.face.length; c++) {
        if (c % 3 === 0) across(p, c, n);
        for (let i = 0; i < 3; i++) p.normals[3 * p.slot[c] + i] += n[i];
      }
      for (let c = 0; c < p.face.length; c++)
        for (let i = 0; i < 3; i++) {
          p.corners[6 * c + i] = p.vertices[3 * p.face[c] + i];
          p.corners[6 * c + 3 + i] = p.normals[3 * p.slot[c] + i];
        }
      gl.bindBuffer(gl.ARRAY_BUFFER, p.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, p.corners, gl.DYNAMIC_DRAW);
    }
  }

  // ---- shaders: light from above, shaded by normals; shadows are the meshes flattened along the light
  const vertexShader = `#version 300 es
    uniform mat4 camera; uniform vec3 sun; uniform float flatten; in vec3 position, normal; out vec3 place, facing;
    void main() {
      vec3 p = position - flatten * sun * (max(position.z, 0.0) / sun.z);
      if (flatten > 0.0) p.z = 0.0;
      place = p;
      facing = normal;
      gl_Position = camera * vec4(p, 1.0);
    }`;
  const fragmentShader = `#version 300 es
    precision highp float;
    uniform vec4 color; uniform vec3 sun, eye; uniform int kind; in vec3 place, facing; out vec4 result;
    void main() {
      if (kind == 1) { result = color; return; }                      // shadow, or a part's number
      if (kind == 2) {                                                // table: a square is 5 cm
        vec2 off = abs(fract(place.xy / 0.05 + 0.5) - 0.5) * 0.05;    // from the nearest lines, in m
        vec2 wide = max(vec2(0.0008), fwidth(place.xy));
        vec2 line = clamp(1.0 - off / wide, 0.0, 1.0) * min(vec2(1.0), 0.0016 / wide);
        float dark = max(line.x, line.y);
        float fade = smoothstep(0.25, ${data.table.toFixed(3)}, length(place.xy));
        result = vec4(mix(mix(color.rgb, color.rgb * 0.78, dark), vec3(0.965, 0.972, 0.98), fade), 1.0);
        return;
      }
      vec3 flat_n = cross(dFdx(place), dFdy(place)), back = normalize(eye - place), light = normalize(sun);
      vec3 n = normalize(dot(facing, facing) > 0.0 ? facing : flat_n);
      if (dot(n, flat_n) < 0.0) n = -n;  // the inside of a surface
      float shade = 0.62 + 0.12 * n.z + 0.40 * max(dot(n, light), 0.0);
      float shine = 0.16 * pow(max(dot(n, normalize(light + back)), 0.0), 32.0);
      float rim = 0.10 * pow(1.0 - max(dot(n, back), 0.0), 3.0);
      result = vec4(color.rgb * shade + shine + rim, color.a);
    }`;
  // What the context holds beside the meshes' buffers.
  let program, uniform, table, scratch;
  function prepare() {
    program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertexShader], [gl.FRAGMENT_SHADER, fragmentShader]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
        throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "position");
    gl.bindAttribLocation(program, 1, "normal");
    gl.linkProgram(program);
    uniform = Object.fromEntries(["camera", "sun", "eye", "color", "kind", "flatten"].map(
      (name) => [name, gl.getUniformLocation(program, name)]));
    table = gl.createBuffer();
    scratch = gl.createBuffer();
    const s = data.table;
    gl.bindBuffer(gl.ARRAY_BUFFER, table);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(
      [[-s, -s], [s, -s], [s, s], [-s, -s], [s, s], [-s, s]].flatMap(([x, y]) => [x, y, 0, 0, 0, 1])), gl.STATIC_DRAW);
  }
  prepare();
  // The browser takes contexts away when a computer sleeps, a driver starts again, or pages have too many.
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();  // which asks for it back
    find("message").textContent = "The browser has taken the 3D view away. If it does not come back, load the page again.";
  });
  canvas.addEventListener("webglcontextrestored", () => {  // as a new one, which holds nothing
    prepare();
    for (const p of parts) p.buffer = gl.createBuffer();
    find("message").textContent = "";
    request();
  });

  // ---- camera: orbits about a point; column-major matrices as WebGL has them
  const home = () => ({ ...data.camera, target: [...data.camera.target] });
  let camera = home();
  const normal = (v) => { const n = Math.hypot(...v); return v.map((x) => x / n); };
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  function axes() {
    const [a, e] = [camera.azimuth, camera.elevation];
    const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const right = normal(cross([0, 0, 1], back));
    return { back, right, up: cross(back, right), eye: camera.target.map((x, i) => x + camera.distance * back[i]) };
  }
  function matrix() {
    const { back, right, up, eye } = axes(), near = 0.02, far = 10;
    const f = 1 / Math.tan(0.36), g = f * canvas.height / canvas.width, depth = 1 / (near - far);
    const row = (v, scale) => [...v.map((x) => scale * x), -scale * dot(v, eye)];
    const [x, y, z] = [row(right, g), row(up, f), row(back, 1)];
    const clip = z.map((v, i) => (near + far) * depth * v + (i === 3 ? 2 * near * far * depth : 0));
    return { eye, flat: [0, 1, 2, 3].flatMap((i) => [x[i], y[i], clip[i], -z[i]]) };
  }

  // ---- drawing
  const sun = [0.45, -0.25, 1.0];
  function triangles(buffer, count, kind, color, flatten) {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 24, 0);
    gl.vertexAttribPointer(1, 3, gl.FLOAT, false, 24, 12);
    gl.uniform1i(uniform.kind, kind);
    gl.uniform4fv(uniform.color, color);
    gl.uniform1f(uniform.flatten, flatten);
    gl.drawArrays(gl.TRIANGLES, 0, count);
  }
  const chosen = (p) => p.name === highlighted;
  const shown = (p) => (chosen(p) ? p.color.map((v) => 0.55 * v + 0.45) : p.color);
  // Clears the picture and sets what all triangles have in common.
  function begin(background) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(ratio * canvas.clientWidth));
    canvas.height = Math.max(1, Math.round(ratio * canvas.clientHeight));
    const { flat, eye } = matrix();
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...background);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.useProgram(program);
    gl.enableVertexAttribArray(0);
    gl.enableVertexAttribArray(1);
    gl.uniformMatrix4fv(uniform.camera, false, flat);
    gl.uniform3fv(uniform.sun, sun);
    gl.uniform3fv(uniform.eye, eye);
    gl.enable(gl.DEPTH_TEST);
  }
  function draw() {
    begin([0.965, 0.972, 0.98, 1]);
    triangles(table, 6, 2, [0.9, 0.88, 0.84, 1], 0);
    // Shadows darken each pixel of the table once: the stencil counts.
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 0xff);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    for (const p of parts) triangles(p.buffer, p.face.length, 1, [0.1, 0.12, 0.15, 0.25], 1);
    gl.disable(gl.STENCIL_TEST);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    // With forces the fingers are glass, through which one sees where they press.
    const glass = contacts && find("forces").checked, clear = (p) => glass && p.name.startsWith("finger");
    for (const p of parts) if (!clear(p)) triangles(p.buffer, p.face.length, 0, [...shown(p), 1], 0);
    if (!glass) return;
    drawForces();
    gl.enable(gl.BLEND);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    for (const p of parts) if (clear(p)) triangles(p.buffer, p.face.length, 0, [...shown(p), 0.3], 0);
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
    gl.disable(gl.BLEND);
  }

  // ---- contact points and forces: an arrow for each part, whose head is where it presses
  const LONGEST = 0.07;  // arrow of the grasp's largest force [m]
  function drawForces() {
    const most = Math.max(...contacts.flat().map(({ force }) => Math.hypot(...force)), 1e-9);
    for (const { part, force, point, points } of contacts[Math.round(time * data.rate)] || []) {
      const corners = points.flatMap((at) => cone(at, [0, 0, 0.004], 0.002, 4).concat(cone(at, [0, 0, -0.004], 0.002, 4)));
      const long = LONGEST / most * Math.hypot(...force), along = normal(force), head = Math.min(0.014, long);
      const back = (way) => point.map((v, i) => v - way * along[i]);
      if (long > 0.003) {
        corners.push(...cone(back(head), along.map((v) => head * v), 0.005, 12));
        corners.push(...cone(back(head), along.map((v) => (head - long) * v), 0.0022, 8, 1));
      }
      gl.bindBuffer(gl.ARRAY_BUFFER, scratch);
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(corners), gl.DYNAMIC_DRAW);
      triangles(scratch, corners.length / 6, 0, [...parts[part].color.map((v) => 0.75 * v), 1], 0);
    }
  }
  // Triangles of a cone from its base's middle to its tip, or with top = 1 of a cylinder, with normals.
  function cone(from, axis, radius, sides, top = 0) {
    const long = Math.hypot(...axis), up = axis.map((v) => v / long), corners = [];
    const first = normal(cross(up, Math.abs(up[2]) > 0.9 ? [1, 0, 0] : [0, 0, 1]));
    const second = cross(up, first);
    const ring = (k, share) => {
      const [c, s] = [Math.cos(2 * Math.PI * k / sides), Math.sin(2 * Math.PI * k / sides)];
      const out = first.map((v, i) => c * v + s * second[i]);
      return [...from.map((v, i) => v + share * axis[i] + radius * (share && !top ? 0 : 1) * out[i]), ...out];
    };
    for (let k = 0; k < sides; k++) {
      corners.push(...ring(k, 0), ...ring(k + 1, 0), ...ring(k + 1, 1));
      if (top) corners.push(...ring(k, 0), ...ring(k + 1, 1), ...ring(k, 1));
      corners.push(...from, ...up.map((v) => -v), ...ring(k + 1, 0).slice(0, 3), ...up.map((v) => -v), ...ring(k, 0).slice(0, 3), ...up.map((v) => -v));
    }
    return corners;
  }

  // ---- what is under the pointer: parts drawn in colours that number them
  let highlighted = null;
  function pick(x, y) {
    begin([0, 0, 0, 1]);
    parts.forEach((p, k) => triangles(p.buffer, p.face.length, 1, [(k + 1) / 255, 0, 0, 1], 0));
    const scale = canvas.width / canvas.clientWidth, pixel = new Uint8Array(4);
    gl.readPixels(scale * x, canvas.height - scale * y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    request();
    return pixel[0] ? parts[pixel[0] - 1].name : null;
  }
  function highlight(name) {
    highlighted = name;
    request();
  }

  // ---- time
  let time = data.still, playing = false, fresh = true, before = 0, queued = false;
  const phase = (t) => (data.phases.find(([, until]) => t < until) || data.phases[data.phases.length - 1])[0];
  function show() {
    skin(time);
    draw();
    slider.value = time;
    const height = 1000 * now[7 * data.object + 2];
    label.textContent = `${time.toFixed(2)} s, ${phase(time)}; object's centre ${height.toFixed(0)} mm above the table`;
    root.dispatchEvent(new CustomEvent("time", { detail: time }));
  }
  function step(stamp) {
    queued = false;
    if (playing) {
      const passed = Math.min(stamp - before, 100) / 1000;
      time += passed * Number(find("speed").value);
      if (find("turning").checked) camera.azimuth += 0.3 * passed;
      before = stamp;
      if (time >= end && data.loop) time = 0;
      if (time >= end) { time = end; pause(); }
      if (playing) request();
    }
    show();
  }
  function request() {
    if (!queued) { queued = true; requestAnimationFrame(step); }
  }
  function play() {
    if (fresh || time >= end) time = 0;
    fresh = false;
    playing = true;
    before = performance.now();
    button.textContent = "Pause";
    request();
  }
  function pause() {
    playing = false;
    button.textContent = "Play";
  }
  function seek(t) {
    fresh = false;
    time = Math.min(Math.max(Number(t), 0), end);
    request();
  }

  function load(grasp) {
    take(grasp);
    time = Math.min(time, end);
    request();
  }

  // ---- controls
  button.addEventListener("click", () => (playing ? pause() : play()));
  slider.addEventListener("input", () => { pause(); seek(slider.value); });
  find("home").addEventListener("click", () => { camera = home(); request(); });
  find("forces").addEventListener("change", request);
  let start = 0;
  for (const [name, until] of data.phases) {
    const mark = document.createElement("button"), from = start;
    mark.textContent = mark.title = name;
    mark.style.flex = `${until - from} 0 0`;
    mark.addEventListener("click", () => { pause(); seek(from); });
    find("phases").append(mark);
    start = until;
  }
  const pointers = new Map();
  let moved = 0;  // [px] since a button was pressed
  canvas.addEventListener("pointerdown", (e) => {
    moved = 0;
    find("turning").checked = false;
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    canvas.setPointerCapture(e.pointerId);
  });
  canvas.addEventListener("click", (e) => {
    const name = moved < 5 ? pick(e.offsetX, e.offsetY) : null;
    if (name) root.dispatchEvent(new CustomEvent("pick", { detail: name }));
  });
  for (const name of ["pointerup", "pointercancel"])
    canvas.addEventListener(name, (e) => pointers.delete(e.pointerId));
  const zoom = (factor) => { camera.distance = Math.min(Math.max(camera.distance * factor, 0.1), 3); };
  canvas.addEventListener("pointermove", (e) => {
    const last = pointers.get(e.pointerId);
    if (!last) return;
    const [dx, dy] = [e.clientX - last[0], e.clientY - last[1]];
    moved += Math.abs(dx) + Math.abs(dy);
    if (pointers.size === 2) {  // two fingers on a touch screen
      const other = [...pointers].find(([id]) => id !== e.pointerId)[1];
      zoom(Math.hypot(last[0] - other[0], last[1] - other[1]) /
        Math.max(Math.hypot(e.clientX - other[0], e.clientY - other[1]), 1));
    } else if (e.shiftKey || e.buttons & 2) {
      const { right, up } = axes(), scale = camera.distance / canvas.clientHeight;
      camera.target = camera.target.map((x, i) => x - scale * dx * right[i] + scale * dy * up[i]);
    } else {
      camera.azimuth -= 0.01 * dx;
      camera.elevation = Math.min(Math.max(camera.elevation + 0.01 * dy, 0.03), 1.55);
    }
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    request();
  });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom(Math.exp(0.001 * e.deltaY));
    request();
  }, { passive: false });
  new ResizeObserver(request).observe(canvas);
  take(data);
  show();
  if (data.turn && !matchMedia("(prefers-reduced-motion: reduce)").matches) {
    find("turning").checked = true;
    const seen = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      seen.disconnect();
      if (fresh) play();
    }, { threshold: 0.6 });
    seen.observe(canvas);
  }
  root.replay = { load, play, pick, highlight, pause, seek, end: () => end, time: () => time, playing: () => playing, camera: () => camera,
    contacts: () => contacts,
    vertices: (name) => Array.from(parts.find((p) => p.name === name).vertices) };
  return root.replay;
}
