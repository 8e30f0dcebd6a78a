// The 3D scene: a point cloud and the cameras in WebGL, drawn only when something changes.
"use strict";
(() => {
  const box = document.getElementById("scene");
  if (!box) return;
  const canvas = box.querySelector("canvas"), label = box.querySelector(".label"), open = box.querySelector(".open");
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = a => { const n = Math.hypot(...a) || 1; return a.map(v => v / n); };
  const FIELD = 50 * Math.PI / 180;  // vertical field of view

  function start() {
    const gl = canvas.getContext("webgl2", { antialias: true });
    if (!gl) { box.classList.add("failed"); return; }
    const scene = JSON.parse(document.getElementById("scene-header").textContent);
    const text = atob(document.getElementById("scene-data").textContent.trim());
    const bytes = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
    const n = scene.points;
    const parts = [bytes.subarray(0, 6 * n), bytes.subarray(6 * n, 9 * n), bytes.subarray(9 * n)];

    const up = unit(scene.up), east = unit(cross(up, Math.abs(up[0]) < 0.8 ? [1, 0, 0] : [0, 1, 0])), north = cross(up, east);
    const path = scene.path, mean = path.reduce((a, b) => add(a, b), [0, 0, 0]).map(v => v / path.length);
    const cells = new Uint16Array(bytes.buffer, 0, 3 * n);
    let view, pending = false, shown = 1, withCameras = true, hovered = -1;

    function startingView() {  // from the side where the cameras were, a little higher, far enough to see nearly all
      const away = unit(sub(mean, scene.middle)), elevation = Math.max(0.2, Math.min(1.2, Math.asin(dot(away, up)) + 0.3));
      view = { target: scene.middle, azimuth: Math.atan2(dot(away, north), dot(away, east)), elevation, distance: 2 * scene.reach };
      const { right, above, back } = frame(), half = Math.tan(FIELD / 2), aspect = canvas.clientWidth / canvas.clientHeight, needed = [];
      for (let i = 0; i < n; i += Math.ceil(n / 4000)) {
        const p = sub([0, 1, 2].map(k => scene.low[k] + cells[3 * i + k] / 65535 * scene.side), scene.middle);
        needed.push(dot(p, back) + Math.max(Math.abs(dot(p, right)) / (half * aspect), Math.abs(dot(p, above)) / half));
      }
      needed.sort((a, b) => a - b);
      view.distance = 1.05 * needed[Math.floor(0.96 * (needed.length - 1))];
      clamp();
    }
    function frame() {
      const c = Math.cos(view.elevation), s = Math.sin(view.elevation);
      const back = add(add(east.map(v => v * c * Math.cos(view.azimuth)), north, c * Math.sin(view.azimuth)), up, s);
      const right = unit(cross(up, back));
      return { eye: add(view.target, back, view.distance), right, back, above: cross(back, right) };
    }
    function matrix() {  // column-major projection times view
      const f = 1 / Math.tan(FIELD / 2), aspect = canvas.width / canvas.height, near = view.distance / 200, far = view.distance + 20 * scene.reach;
      const { eye, right, above, back } = frame(), a = (far + near) / (near - far), b = 2 * far * near / (near - far);
      const rows = [[...right.map(v => v * f / aspect), -dot(right, eye) * f / aspect], [...above.map(v => v * f), -dot(above, eye) * f],
        [...back.map(v => v * a), -dot(back, eye) * a + b], [...back.map(v => -v), dot(back, eye)]];
      return new Float32Array([0, 1, 2, 3].flatMap(j => rows.map(row => row[j])));
    }

    const program = (vertex, fragment) => {
      const p = gl.createProgram();
      for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
        const shader = gl.createShader(kind);
        gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + source);
        gl.compileShader(shader);
        gl.attachShader(p, shader);
      }
      gl.linkProgram(p);
      if (!gl.getProgramParameter(p, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(p));
      return p;
    };
    const dots = program(
      `layout(location=0) in vec3 cell; layout(location=1) in vec3 filmed; layout(location=2) in vec3 restored;
       uniform mat4 m; uniform vec3 low; uniform float side, size, which; out vec3 color;
       void main() { gl_Position = m * vec4(low + cell * side, 1.0); gl_PointSize = clamp(size / gl_Position.w, 1.5, 24.0); color = mix(filmed, restored, which); }`,
      `in vec3 color; out vec4 o; void main() { if (length(gl_PointCoord - 0.5) > 0.5) discard; o = vec4(color, 1.0); }`);
    const lines = program(`layout(location=0) in vec3 at; uniform mat4 m; void main() { gl_Position = m * vec4(at, 1.0); }`,
      `uniform vec4 color; out vec4 o; void main() { o = color; }`);
    const buffer = data => { const b = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, b); gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW); return b; };
    const array = attributes => {
      const v = gl.createVertexArray();
      gl.bindVertexArray(v);
      attributes.forEach(([data, kind], k) => {
        buffer(data);
        gl.enableVertexAttribArray(k);
        gl.vertexAttribPointer(k, 3, kind, kind !== gl.FLOAT, 0, 0);
      });
      return v;
    };
    const cloud = array([[parts[0], gl.UNSIGNED_SHORT], [parts[1], gl.UNSIGNED_BYTE], [parts[2], gl.UNSIGNED_BYTE]]);
    const edges = scene.cameras.flatMap(({ xyz: [c, ...corners] }) => corners.flatMap((p, k) => [c, p, p, corners[(k + 1) % 4]])).flat();
    const frusta = array([[new Float32Array(edges), gl.FLOAT]]), track = array([[new Float32Array(path.flat()), gl.FLOAT]]);
    const place = (p, names) => Object.fromEntries(names.map(name => [name, gl.getUniformLocation(p, name)]));
    const ofDots = place(dots, ["m", "low", "side", "size", "which"]), ofLines = place(lines, ["m", "color"]);

    function draw() {
      pending = false;
      const ratio = Math.min(devicePixelRatio || 1, 2), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
      if (!width || !height) return;
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      gl.viewport(0, 0, width, height);
      gl.enable(gl.DEPTH_TEST);
      gl.clearColor(0.03, 0.115, 0.15, 1);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const m = matrix();
      gl.useProgram(dots);
      gl.uniformMatrix4fv(ofDots.m, false, m);
      gl.uniform3fv(ofDots.low, scene.low);
      gl.uniform1f(ofDots.side, scene.side);
      gl.uniform1f(ofDots.size, 2.6 * scene.spacing * height / (2 * Math.tan(FIELD / 2)));
      gl.uniform1f(ofDots.which, shown);
      gl.bindVertexArray(cloud);
      gl.drawArrays(gl.POINTS, 0, n);
      if (!withCameras) return;
      gl.useProgram(lines);
      gl.uniformMatrix4fv(ofLines.m, false, m);
      gl.bindVertexArray(track);
      gl.uniform4f(ofLines.color, 1, 0.82, 0.4, 1);
      gl.drawArrays(gl.LINE_STRIP, 0, path.length);
      gl.bindVertexArray(frusta);
      gl.uniform4f(ofLines.color, 0.82, 0.93, 0.96, 1);
      gl.drawArrays(gl.LINES, 0, edges.length / 3);
      if (hovered >= 0) { gl.uniform4f(ofLines.color, 1, 0.45, 0.3, 1); gl.drawArrays(gl.LINES, 16 * hovered, 16); }
    }
    const redraw = () => { if (!pending) { pending = true; requestAnimationFrame(draw); } };

    function onScreen(p) {
      const m = matrix(), v = [0, 1, 3].map(r => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
      return v[2] > 0 ? [(v[0] / v[2] + 1) / 2 * canvas.clientWidth, (1 - v[1] / v[2]) / 2 * canvas.clientHeight] : null;
    }
    function cameraAt(x, y) {
      let best = -1, nearest = 14;
      if (withCameras) scene.cameras.forEach(({ xyz }, k) => {
        const p = onScreen(xyz[0]), d = p ? Math.hypot(p[0] - x, p[1] - y) : Infinity;
        if (d < nearest) [best, nearest] = [k, d];
      });
      return best;
    }
    function hover(k, x = 0, y = 0) {
      if (k !== hovered) redraw();
      hovered = k;
      label.hidden = k < 0;
      if (k < 0) return;
      label.textContent = scene.cameras[k].name;
      label.style.transform = `translate(${Math.min(x + 12, canvas.clientWidth - label.offsetWidth - 4)}px, ${Math.max(y - 30, 4)}px)`;
    }
    function goTo(k) {  // look from where a camera was
      const [c, ...corners] = scene.cameras[k].xyz, ahead = unit(sub(corners.reduce((a, b) => add(a, b), [0, 0, 0]).map(v => v / 4), c));
      const reach = Math.max(dot(sub(scene.middle, c), ahead), 0.4 * scene.reach);
      view = { target: add(c, ahead, reach), distance: reach, elevation: Math.asin(Math.max(-1, Math.min(1, -dot(ahead, up)))), azimuth: Math.atan2(-dot(ahead, north), -dot(ahead, east)) };
      clamp();
    }
    function clamp() {
      view.elevation = Math.max(-1.5, Math.min(1.55, view.elevation));
      view.distance = Math.max(0.05 * scene.reach, Math.min(12 * scene.reach, view.distance));
      redraw();
    }
    const turn = (x, y) => { view.azimuth -= x; view.elevation += y; clamp(); };
    const zoom = factor => { view.distance *= factor; clamp(); };
    function pan(x, y) {
      const { right, above } = frame(), s = view.distance * 2 * Math.tan(FIELD / 2) / canvas.clientHeight;
      view.target = add(add(view.target, right, -x * s), above, y * s);
      redraw();
    }

    const fingers = new Map();
    let moved = 0;
    canvas.addEventListener("pointerdown", e => { canvas.focus(); canvas.setPointerCapture(e.pointerId); fingers.set(e.pointerId, [e.offsetX, e.offsetY]); moved = 0; });
    canvas.addEventListener("pointermove", e => {
      const before = fingers.get(e.pointerId);
      if (!before) { const k = cameraAt(e.offsetX, e.offsetY); hover(k, e.offsetX, e.offsetY); return; }
      const dx = e.offsetX - before[0], dy = e.offsetY - before[1], others = [...fingers.entries()].filter(([id]) => id !== e.pointerId);
      moved += Math.hypot(dx, dy);
      if (others.length) {
        const [ox, oy] = others[0][1], old = Math.hypot(before[0] - ox, before[1] - oy), now = Math.hypot(e.offsetX - ox, e.offsetY - oy);
        pan(dx / 2, dy / 2);
        zoom(old / Math.max(now, 1));
      } else if (e.shiftKey || e.buttons === 2) pan(dx, dy);
      else turn(dx * 0.007, dy * 0.007);
      fingers.set(e.pointerId, [e.offsetX, e.offsetY]);
    });
    const lift = e => {
      if (fingers.delete(e.pointerId) && e.type === "pointerup" && moved < 5) { const k = cameraAt(e.offsetX, e.offsetY); if (k >= 0) goTo(k); }
    };
    canvas.addEventListener("pointerup", lift);
    canvas.addEventListener("pointercancel", lift);
    canvas.addEventListener("pointerleave", () => hover(-1));
    canvas.addEventListener("contextmenu", e => e.preventDefault());
    canvas.addEventListener("wheel", e => {  // the page scrolls on until the scene was clicked
      if (document.activeElement !== canvas) return;
      e.preventDefault();
      zoom(Math.exp(0.0012 * e.deltaY));
    }, { passive: false });
    canvas.addEventListener("keydown", e => {
      const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
      if (steps && e.shiftKey) pan(-30 * steps[0], 30 * steps[1]);
      else if (steps) turn(-0.12 * steps[0], 0.12 * steps[1]);
      else if (e.key === "+" || e.key === "=") zoom(0.85);
      else if (e.key === "-") zoom(1.18);
      else if (e.key === "Home") startingView();
      else return;
      e.preventDefault();
    });
    box.querySelectorAll("input[name=scene-colors]").forEach(input => input.addEventListener("change", () => { shown = Number(input.value); redraw(); }));
    box.querySelector(".cameras").addEventListener("change", e => { withCameras = e.target.checked; hover(-1); redraw(); });
    box.querySelector(".home").addEventListener("click", startingView);
    new ResizeObserver(redraw).observe(canvas);
    box.classList.add("running");
    startingView();
  }

  open.addEventListener("click", () => { if (!box.classList.contains("running")) start(); canvas.focus(); });
  if (matchMedia("(pointer: fine)").matches) {  // phones ask first: there a finger on the scene no longer scrolls the page
    new IntersectionObserver((entries, observer) => {
      if (entries.some(entry => entry.isIntersecting)) { observer.disconnect(); if (!box.classList.contains("running")) start(); }
    }).observe(box);
  }
})();
