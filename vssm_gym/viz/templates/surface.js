// Show a surface and the paths of a camera, and turn them by mouse, touch and keys. See vssm_gym/viz/surface_view.py.
"use strict";
(() => {
  const canvas = document.querySelector("canvas[data-surface]");
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
  if (!gl) return; // the picture below stays
  const bytes = Uint8Array.from(atob(canvas.dataset.surface.split(",")[1]), (c) => c.charCodeAt(0)).buffer;
  const [vertices, faces, estimate, truth] = new Uint32Array(bytes, 0, 4);
  const [lowX, lowY, lowZ, step, centreX, centreY, centreZ, radius, turn, rise] = new Float32Array(bytes, 16, 10);
  let at = 56;
  const take = (size) => { at += size; return new Uint8Array(bytes, at - size, size); };
  const fill = (data, target = gl.ARRAY_BUFFER) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(target, buffer);
    gl.bufferData(target, data, gl.STATIC_DRAW);
    return buffer;
  };
  const program = (vertex, fragment) => {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, "#version 300 es\nprecision highp float;\n" + text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    return made;
  };

  // Surface: colours of the map, lit from above; the normal of a face is that of its own plane.
  const solid = program(
    `uniform mat4 view; uniform vec3 low; uniform float size; in vec3 place; in vec3 colour; out vec3 p; out vec3 c;
     void main() { p = low + size * place; c = colour; gl_Position = view * vec4(p, 1.0); }`,
    `in vec3 p; in vec3 c; out vec4 shown;
     void main() { vec3 n = normalize(cross(dFdx(p), dFdy(p)));
       shown = vec4(c * (0.72 + 0.28 * max(0.0, dot(n, normalize(vec3(-0.35, -0.5, 0.8))))), 1.0); }`);
  const surface = gl.createVertexArray();
  gl.bindVertexArray(surface);
  const attribute = (of, name, count, kind, scaled, stride, offset, divisor = 0) => {
    const place = gl.getAttribLocation(of, name);
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, count, kind, scaled, stride, offset);
    gl.vertexAttribDivisor(place, divisor);
  };
  fill(take(8 * vertices));
  attribute(solid, "place", 3, gl.UNSIGNED_SHORT, false, 8, 0);
  fill(take(4 * vertices));
  attribute(solid, "colour", 3, gl.UNSIGNED_BYTE, true, 4, 0);
  fill(take(12 * faces), gl.ELEMENT_ARRAY_BUFFER);

  // Lines: each segment is a strip of two triangles that face the viewer, some pixels wide.
  const thin = program(
    `uniform mat4 view; uniform vec2 pixel; in vec3 a; in vec3 b;
     void main() { vec4 p = view * vec4(a, 1.0), q = view * vec4(b, 1.0);
       vec2 along = normalize((q.xy / q.w - p.xy / p.w) / pixel + 1e-6);
       vec4 end = gl_VertexID < 2 ? p : q; float side = gl_VertexID % 2 == 0 ? 1.0 : -1.0;
       gl_Position = end + vec4(side * vec2(-along.y, along.x) * pixel * end.w, 0.0, 0.0); }`,
    `uniform vec4 colour; out vec4 shown; void main() { shown = vec4(colour.rgb * colour.a, colour.a); }`);
  const segments = gl.createVertexArray();
  gl.bindVertexArray(segments);
  const ends = fill(take(24 * (estimate + truth)));

  // The viewer: an angle around the vertical, one above the horizon, and a distance.
  const first = { turn, rise, away: 1.9 * radius };
  let viewer = { ...first }, asked = false;
  const eye = () => {
    const [c, s, e] = [Math.cos(viewer.turn), Math.sin(viewer.turn), viewer.rise];
    const ahead = [-c * Math.cos(e), -s * Math.cos(e), -Math.sin(e)], right = [-s, c, 0];
    const up = [-c * Math.sin(e), -s * Math.sin(e), Math.cos(e)];
    const middle = [centreX, centreY, centreZ], dot = (u, v) => u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
    const f = 2.6, aspect = canvas.width / canvas.height, wide = Math.min(1, aspect);
    const near = 0.02 * viewer.away, far = viewer.away + 6 * radius, k = (far + near) / (far - near);
    const depth = viewer.away - dot(ahead, middle), m = 2 * far * near / (far - near);
    const x = f * wide / aspect, y = f * wide;
    return [0, 1, 2].flatMap((i) => [x * right[i], y * up[i], k * ahead[i], ahead[i]])
      .concat([-x * dot(right, middle), -y * dot(up, middle), k * depth - m, depth]);
  };
  const colour = (name) => {
    const found = /^#(..)(..)(..)$/.exec(getComputedStyle(canvas).getPropertyValue(name).trim());
    return found ? found.slice(1).map((part) => parseInt(part, 16) / 255) : [0, 0, 0];
  };
  const draw = () => {
    asked = false;
    const scale = Math.min(devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * scale));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * scale));
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const view = new Float32Array(eye());
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE); // a wall is seen from its room only
    gl.disable(gl.BLEND);
    gl.depthFunc(gl.LESS);
    gl.depthMask(true);
    gl.useProgram(solid);
    gl.uniformMatrix4fv(gl.getUniformLocation(solid, "view"), false, view);
    gl.uniform3f(gl.getUniformLocation(solid, "low"), lowX, lowY, lowZ);
    gl.uniform1f(gl.getUniformLocation(solid, "size"), step);
    gl.bindVertexArray(surface);
    gl.drawElements(gl.TRIANGLES, 3 * faces, gl.UNSIGNED_INT, 0);
    gl.disable(gl.CULL_FACE);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    gl.useProgram(thin);
    gl.uniformMatrix4fv(gl.getUniformLocation(thin, "view"), false, view);
    gl.uniform2f(gl.getUniformLocation(thin, "pixel"), 1.8 * scale / canvas.width, 1.8 * scale / canvas.height);
    gl.bindVertexArray(segments);
    gl.bindBuffer(gl.ARRAY_BUFFER, ends);
    // Behind the surface a line is faint; it is drawn first.
    for (const [test, alpha] of [[gl.GREATER, 0.25], [gl.LEQUAL, 1]]) {
      gl.depthFunc(test);
      for (const [from, count, name] of [[estimate, truth, "--truth"], [0, estimate, "--estimate"]]) {
        attribute(thin, "a", 3, gl.FLOAT, false, 24, 24 * from, 1);
        attribute(thin, "b", 3, gl.FLOAT, false, 24, 24 * from + 12, 1);
        gl.uniform4f(gl.getUniformLocation(thin, "colour"), ...colour(name), alpha);
        gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
      }
    }
  };
  const ask = () => { if (!asked) { asked = true; requestAnimationFrame(draw); } };
  const move = (turn, rise, factor) => {
    viewer.turn += turn;
    viewer.rise = Math.min(1.55, Math.max(-1.2, viewer.rise + rise));
    viewer.away = Math.min(6 * radius, Math.max(0.3 * radius, viewer.away * factor));
    ask();
  };

  // One finger or the mouse turns; two fingers tilt and zoom, so that one still scrolls the page up and down.
  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    held.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], others = [...held].filter(([id]) => id !== event.pointerId);
    const share = 1 / held.size, [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    const apart = (p) => Math.hypot(p[0] - others[0][1][0], p[1] - others[0][1][1]) || 1;
    move(-0.008 * dx * share, 0.008 * dy * share, others.length ? apart(before) / apart(now) : 1);
    held.set(event.pointerId, now);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas) return; // a page that is only scrolled by is not caught
    event.preventDefault();
    move(0, 0, Math.exp(0.001 * event.deltaY));
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { viewer = { ...first }; ask(); });
  const keys = { ArrowLeft: [0.1, 0, 1], ArrowRight: [-0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1],
    "+": [0, 0, 0.9], "-": [0, 0, 1.1] };
  canvas.addEventListener("keydown", (event) => {
    if (keys[event.key]) { event.preventDefault(); move(...keys[event.key]); }
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", ask);
  new ResizeObserver(ask).observe(canvas);
  canvas.parentNode.classList.add("live");
  draw();
})();
